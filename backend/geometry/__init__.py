"""Outlines, faces, pieces and towers, with exact statics."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.geometry import (
        cad,
        drawings,
        families,
        outlines,
        pieces,
        regions,
        sampling,
        surfaces,
        tower,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
