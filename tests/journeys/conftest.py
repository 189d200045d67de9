"""A window whose time the test turns shows at once what is to be shown."""

from tests.prompt_window import prompt

__all__ = ["prompt"]
