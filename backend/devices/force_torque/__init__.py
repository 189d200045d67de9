"""Wrist force/torque sensors: shared reader, sample clock and links."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.devices.force_torque import driver, reader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
