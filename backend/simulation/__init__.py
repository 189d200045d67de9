"""The simulated bench: contact physics, gel, sensors, and its batch version."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.simulation import (
        arm,
        batch,
        conditions,
        contact,
        finger_camera,
        gripper,
        ground_truth,
        marker_fields,
        mechanics,
        pressing,
        release_mujoco,
        staged_release,
        supports,
        world,
        wrist_sensor,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
