"""The real-time process that owns the links to the devices, and its client."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.rig import connection, diagnostics, flight_recorder, link, remote_devices

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
