"""Theme, panels, labels and other building blocks."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.widgets.base import freshness, panel, rows, theme

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
