"""The command line, one module a verb."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.cli import command_line

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
