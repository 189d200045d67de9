"""Touchdown without a screen. Packages import each other downwards only, from sensor to action."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend import (
        __main__,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
