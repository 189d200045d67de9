from .command_line import main as main

__all__ = ["main"]
