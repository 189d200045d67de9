"""Tactile cameras: shared driver parts, frame checks and camera sources."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.devices.cameras import frames, sources

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
