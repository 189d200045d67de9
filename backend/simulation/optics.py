"""Renders tactile images: 320x240 BGR from the displacement of the 63 markers.

Source: bench reference 7. I = B + P + m (core - B - P) + n with the background B, the fixed grain
P, the temporal noise n and the dot mask m. B + P is computed once; a frame draws the dots and adds
a random window of a noise bank, because a fresh normal for each of 230,400 values would cost more
than everything else. Colours are done one after the other: one plane fits into the cache.
"""

from __future__ import annotations

import json
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray, ImageArray, read_only
from backend.simulation.dots import HEIGHT_PX, WIDTH_PX, Dots, Float32
from backend.simulation.gel_look import GelLook

SMEAR_RADIUS_PX = 13.0
_FRINGE = ((0, -4), (-4, 0), (0, 4))
"""Where the shadow of a dot falls in B, G, R: the lights come from three sides (u, v in px)."""
_FRINGE_DEPTH = 0.5
_FRINGE_PX = 4
_BANK_FACTOR = 2

Smear = tuple[slice, slice, Float32]
"""Rows and columns of what a smear covers, and how much (0..1)."""


class FingerOptics:
    """One finger's camera. Same seed, same calls: the same bytes.

    ``still_px``: so little may the dots have moved unseen.
    """

    def __init__(self, look: GelLook, seed: int, still_px: float = 0.0) -> None:
        self.look = look
        fixed = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 1])))
        self._draws = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 2])))
        self._back = _grain(look, fixed)
        self._back += _background(look.background.tobytes(), look.background.shape)
        self._to_core = look.core.astype(np.float32)[:, None, None] - self._back
        self._dots = Dots(look, fixed, still_px)
        self._bank = _noise_bank(json.dumps(fixed.bit_generator.state), look.noise)
        margin = 2 * _FRINGE_PX
        shadow = np.zeros((HEIGHT_PX + margin, WIDTH_PX + margin), dtype=np.float32)
        self._shadow = _moved(shadow, 0, 0)
        self._fringes = [_moved(shadow, du, dv) for du, dv in _FRINGE]
        self._shaded = np.empty((3, HEIGHT_PX, WIDTH_PX), dtype=np.float32)
        self._smeared = False
        self._plane = np.empty((HEIGHT_PX, WIDTH_PX), dtype=np.float32)
        self._levels = [np.empty((HEIGHT_PX, WIDTH_PX), dtype=np.uint8) for _ in range(3)]

    def render(self, displacement_px: FloatArray, hidden: NDArray[np.bool_]) -> ImageArray:
        """Return the image for ``displacement_px`` (63, 2); smears cover ``hidden`` dots (63,)."""
        changed = self._dots.draw(displacement_px)
        if changed:
            np.multiply(self._dots.mask, np.float32(_FRINGE_DEPTH), out=self._shadow)
        covered_px = (self.look.rest_px + displacement_px)[hidden]
        smears = [smear for centre_px in covered_px if (smear := _smear(centre_px))]
        fresh, self._smeared = changed or bool(smears) or self._smeared, bool(smears)
        rows = self._draws.integers(0, (_BANK_FACTOR - 1) * HEIGHT_PX, 3).tolist()
        columns = self._draws.integers(0, (_BANK_FACTOR - 1) * WIDTH_PX, 3).tolist()
        for channel, (row, column) in enumerate(zip(rows, columns, strict=True)):
            if fresh:
                self._shade(channel, smears)
            noise = self._bank[channel, row : row + HEIGHT_PX, column : column + WIDTH_PX]
            cv2.add(self._shaded[channel], noise, self._plane)
            # Rounds and saturates in one pass; levels are never far below zero, so their sign is
            # safe.
            cv2.convertScaleAbs(self._plane, self._levels[channel])
        return np.asarray(cv2.merge(self._levels), dtype=np.uint8)

    def _shade(self, channel: int, smears: list[Smear]) -> None:
        """Lay the dots, their coloured shadows and smears over the resting image of a colour."""
        plane = self._shaded[channel]
        # OpenCV takes windows of larger arrays in half the time.
        cv2.max(self._dots.mask, self._fringes[channel], plane)
        np.multiply(self._to_core[channel], plane, out=plane)
        plane += self._back[channel]
        for rows, columns, cover in smears:
            there = plane[rows, columns]
            there += cover * (np.float32(self.look.smear[channel]) - there)


def _moved(wide: Float32, du: int, dv: int) -> Float32:
    """Return the image within ``wide``, which has a margin, moved by (du, dv)."""
    u, v = _FRINGE_PX - du, _FRINGE_PX - dv
    return wide[v : v + HEIGHT_PX, u : u + WIDTH_PX]


def _smear(centre_px: FloatArray) -> Smear | None:
    """Return what a smear at ``centre_px`` (2,) covers, None out of sight."""
    reach = int(SMEAR_RADIUS_PX + 6)
    u, v = (int(value) for value in np.floor(centre_px))
    u0, u1 = max(u - reach, 0), min(u + reach + 1, WIDTH_PX)
    v0, v1 = max(v - reach, 0), min(v + reach + 1, HEIGHT_PX)
    if u0 >= u1 or v0 >= v1:
        return None
    du = np.arange(u0, u1) - centre_px[0]
    dv = np.arange(v0, v1) - centre_px[1]
    distance = np.hypot(du[None, :], dv[:, None])
    cover = (1.0 / (1.0 + np.exp((distance - SMEAR_RADIUS_PX) / 1.5))).astype(np.float32)
    return slice(v0, v1), slice(u0, u1), cover


@lru_cache(maxsize=4)
def _background(colours: bytes, shape: tuple[int, ...]) -> Float32:
    """Return (3, 240, 320): cubic interpolation of the colour table, smoothed over 20 px.

    Kept from scene to scene, which all have the same few gels: the blur takes long.
    """
    table = np.frombuffer(colours).reshape(shape).astype(np.float32)
    large = cv2.resize(table, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    smooth = cv2.GaussianBlur(large, (0, 0), 20.0, borderType=cv2.BORDER_REPLICATE)
    planes = np.ascontiguousarray(np.asarray(smooth, dtype=np.float32).transpose(2, 0, 1))
    read_only(planes)
    return planes


@lru_cache(maxsize=4)
def _noise_bank(state: str, deviation: float) -> Float32:
    """Return (3, 480, 640) noise drawn by a generator in ``state``.

    Kept for the fingers of two scenes: one that is set anew with the same seed is ready sooner.
    """
    draws = np.random.Generator(np.random.PCG64())
    draws.bit_generator.state = json.loads(state)
    shape = (3, _BANK_FACTOR * HEIGHT_PX, _BANK_FACTOR * WIDTH_PX)
    bank = draws.standard_normal(shape, dtype=np.float32)
    bank *= np.float32(deviation)
    read_only(bank)
    return bank


def _grain(look: GelLook, rng: np.random.Generator) -> Float32:
    """Return (3, 240, 320): Gaussian pattern of correlation 1 px and the look's deviation."""
    white = rng.standard_normal((HEIGHT_PX, WIDTH_PX, 3), dtype=np.float32)
    smooth = np.asarray(cv2.GaussianBlur(white, (0, 0), 1.0), dtype=np.float32)
    smooth *= np.float32(look.grain / float(smooth.std()))
    return np.ascontiguousarray(smooth.transpose(2, 0, 1))
