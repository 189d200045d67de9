"""Driver of tactile cameras through the package ``lerobot``.

Any camera class of LeRobot can be the source. Its robots are not adapted: they take joint positions
without force, pose or time.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.config import GelsightSettings, HardwareSettings
from touchdown.backend.core import Finger, ImageArray, InputError, Stream, TactileFrame, parse_json
from touchdown.backend.devices.gelsight import TactileCamera
from touchdown.backend.devices.protocols import Identity

FIELD = "lerobot.config"


class LeRobotSource:
    """An open camera of LeRobot; ``make`` returns one that is not connected yet."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.lost = 0
        try:
            self._camera = make()
            self._camera.connect()
        except (RuntimeError, ValueError, ConnectionError) as error:
            raise OSError(str(error)) from error
        told = {name: getattr(self._camera, name, None) for name in ("fps", "width", "height")}
        self.facts: Mapping[str, float] = {k: float(v) for k, v in told.items() if v}

    def read(self, limit_s: float) -> ImageArray | None:
        """Return the next picture, (rows, columns, 3) BGR; None after the time limit."""
        try:
            picture = self._camera.async_read(timeout_ms=1e3 * limit_s)
        except TimeoutError:
            return None
        except RuntimeError as error:
            raise OSError(str(error)) from error
        image = np.asarray(picture, dtype=np.uint8)
        if str(getattr(self._camera.color_mode, "value", self._camera.color_mode)) == "bgr":
            return image
        return np.ascontiguousarray(image[:, :, ::-1])

    def close(self) -> None:
        """Close the camera."""
        if self._camera.is_connected:
            self._camera.disconnect()


def make_lerobot(
    finger: Finger,
    settings: HardwareSettings,
    now_s: Callable[[], float],
    frames: Stream[TactileFrame],
) -> TactileCamera:
    """Return the camera of one finger; raises ``InputError`` for invalid fields."""
    table = settings.lerobot
    fields = table.left if finger == "left" else table.right
    make = _maker(table.config, fields, f"lerobot.{finger}")

    def open_camera(path: Path, wanted: GelsightSettings) -> LeRobotSource:
        return LeRobotSource(make)

    who = Identity("LeRobot", table.config.rpartition(":")[2], fields, "")
    return TactileCamera(finger, settings.gelsight, now_s, frames, open_camera, who)


def _maker(config: str, fields: str, where: str) -> Callable[[], Any]:
    """Return the factory of the camera of ``config`` ("module:Class") with ``fields`` (JSON)."""
    module, _, name = config.partition(":")
    try:
        content = parse_json(fields)
        kind = getattr(importlib.import_module(module), name)
        wanted = kind(**content)
        make = importlib.import_module("lerobot.cameras.utils").make_cameras_from_configs
    except ImportError as error:
        step = 'Install it: pip install "touchdown[lerobot]".'
        raise InputError(f"LeRobot cannot be loaded: {error}.", FIELD, step) from error
    except (AttributeError, TypeError, ValueError) as error:
        step = "Give the fields of that camera's configuration as JSON."
        raise InputError(f"LeRobot has no such camera: {error}.", where, step) from error
    return lambda: make({"finger": wanted})["finger"]
