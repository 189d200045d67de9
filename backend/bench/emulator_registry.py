"""Emulation of a device by the name of its make, served over the wire of the real one.

A camera without a scene shows a rendered gel that is gently sheared, or a recorded clip; a wrist
sensor carries a hanging gripper.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from touchdown.backend.core import MARKERS, Finger, ImageArray, InputError, check_file
from touchdown.backend.devices import emulated_makes
from touchdown.backend.emulation import (
    BenchTables,
    Emulation,
    EmulationChoice,
    Faults,
    PictureFunction,
)
from touchdown.backend.simulation import TactileRenderer, load_gel_appearance, mirror_appearance

STILL_NOISE = 1.0  # grey levels added to a still picture: two camera pictures are never equal


def sheared_gel(finger: Finger, amplitude_px: float = 3.0) -> PictureFunction:
    """Return the pictures of a gel whose markers swing by ``amplitude_px`` every 4 s."""
    look = load_gel_appearance() if finger == "left" else mirror_appearance(load_gel_appearance())
    optics = TactileRenderer(look, 0)
    hidden = np.zeros(MARKERS, dtype=np.bool_)

    def seen(now_s: float) -> ImageArray:
        swing_px = amplitude_px * math.sin(0.5 * math.pi * now_s)
        return optics.render(np.tile([swing_px, 0.5 * swing_px], (MARKERS, 1)), hidden)

    return seen


def recorded(path: Path, seed: int = 0) -> PictureFunction:
    """Return the pictures of a video, one a call, from the start again at its end; or of a still.

    Raises ``InputError`` if OpenCV reads neither.
    """
    check_file(path, "Name a picture or a video.")
    still = cv2.imread(str(path)) if path.is_file() else None
    if still is not None:
        rng = np.random.default_rng(seed)
        flat = still.astype(np.float64)

        def trembling(now_s: float) -> ImageArray:
            noisy = flat + STILL_NOISE * rng.standard_normal(flat.shape)
            return np.asarray(np.clip(np.round(noisy), 0, 255), dtype=np.uint8)

        return trembling
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        fix = "Name a file that OpenCV reads."
        raise InputError("This is neither a picture nor a video.", str(path), fix)

    def playing(now_s: float) -> ImageArray:
        there, picture = capture.read()
        if not there:
            capture.set(cv2.CAP_PROP_POS_FRAMES, 0.0)
            there, picture = capture.read()
        return np.asarray(picture, dtype=np.uint8)

    return playing


def emulate(choice: EmulationChoice) -> Emulation:
    """Make the emulated device; call ``start`` to serve it.

    Raises
    ------
    InputError
        If there is no such emulator, or if its wire cannot be made.

    """
    makes = emulated_makes()
    if choice.kind not in makes:
        fix = f"Use one of {', '.join(makes)}."
        raise InputError(f"There is no emulated '{choice.kind}'.", "emulate", fix)
    if choice.tty is not None and choice.port is not None:
        raise InputError("A wire is either serial or TCP.", "--tty, --port", "Give one of them.")
    make = makes[choice.kind]
    device: str = make.kind
    if make.kind == "tactile":
        device = f"tactile_{choice.finger}"
        if choice.pictures is None:
            film = recorded(choice.film) if choice.film else sheared_gel(choice.finger)
            choice = replace(choice, pictures=film)
    try:
        emulation: Emulation = make.load_emulator()(choice, Faults(device, choice.faults))
    except OSError as error:
        where = str(choice.tty) if choice.tty else f"{choice.host}:{choice.port or 0}"
        what = f"The wire cannot be made: {error.strerror or error}."
        fix = "Choose another --port or --tty; ports below 1024 need special rights."
        raise InputError(what, where, fix) from error
    return emulation


def bench_toml(bench: BenchTables) -> str:
    """Return the tables of a bench file as TOML."""
    tables = (
        "\n".join([f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())])
        for name, table in bench.items()
    )
    return "\n\n".join(tables) + "\n"
