"""Servers, pacing and fault plans that emulated devices share."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.emulation import fault_plan, server, serving, simulated_disturbances

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
