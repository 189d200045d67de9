"""Device protocols, interlock, jog, safety trips, sensor faults and the registry of makes."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.devices import (
        discovery,
        factories,
        guarded_devices,
        interlock,
        jog,
        protocols,
        registry,
        safety_trips,
        sensor_faults,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
