"""Mitsubishi MELFA arm with CR controller."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.devices.melfa import (
        driver,
        emulated_controller,
        emulator,
        force_program,
        kinematics,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
