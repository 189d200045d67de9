"""Sessions on a bench: simulated, emulated or of a laboratory."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.bench import (
        assembly,
        emulated,
        emulated_scene,
        emulator_registry,
        laboratory,
        session,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
