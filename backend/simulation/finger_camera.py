"""The simulated finger camera: exposure times, marker noise, and rendered tactile images.

Images are 320x240 BGR, rendered from the displacement of the 63 markers as
I = B + P + m (core - B - P) + n with the background B, the fixed grain P, the temporal noise n and
the dot mask m. B + P is computed once; a frame draws the dots and adds a random window of a noise
bank, which is faster than drawing 230,400 normal values. Colours are processed one after the other,
since one plane fits into the cache. The mask is the maximum of 63 logistic discs, deformed to
ellipses by the local displacement gradient; light flecks move with their dot. Dot grid, colours and
grain of a gel at rest are read from resources/gels.
"""

from __future__ import annotations

import json
import threading
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from importlib import resources
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import TactileSettings
from touchdown.backend.core import GRID_COLS, GRID_ROWS, MARKERS, FloatArray, ImageArray, read_only


@dataclass(frozen=True, slots=True)
class GelAppearance:
    """Appearance of one kind of gel (colours are B, G, R levels).

    ``rest_px`` (63, 2) row-major dot centres; ``background`` (3, 4, 3) colours at the centres
    (40 + 80 c, 40 + 80 r); ``radius_px`` at half contrast and ``edge_px`` of the logistic edge;
    ``grain`` and ``noise``: standard deviations of the fixed pattern and of every frame, levels.
    """

    name: str
    rest_px: FloatArray
    background: FloatArray
    core: FloatArray
    smear: FloatArray
    radius_px: float
    edge_px: float
    grain: float
    noise: float

    def __post_init__(self) -> None:
        for array in (self.rest_px, self.background, self.core, self.smear):
            read_only(array)


@cache
def load_gel_appearance(name: str = "large-dot") -> GelAppearance:
    """Return the gel ``name`` that ships with Touchdown."""
    text = (
        resources.files("touchdown.resources").joinpath("gels", f"{name}.toml").read_text("utf-8")
    )
    raw = tomllib.loads(text)
    rest_px = np.array(raw["rest_px"], dtype=np.float64)
    if rest_px.shape != (GRID_ROWS, GRID_COLS, 2):
        raise ValueError(f"gel {name}: rest_px is {rest_px.shape}, not 7 x 9 x 2")
    colours: dict[str, Any] = {
        k: np.array(raw[k], dtype=np.float64) for k in ("background", "core", "smear")
    }
    numbers: dict[str, Any] = {k: float(raw[k]) for k in ("radius_px", "edge_px", "grain", "noise")}
    return GelAppearance(str(raw["name"]), rest_px.reshape(MARKERS, 2), **colours, **numbers)


def mirror_appearance(look: GelAppearance, width_px: int = 320) -> GelAppearance:
    """Return the appearance of the opposite finger: mirrored left to right, order row-major."""
    grid = look.rest_px.reshape(GRID_ROWS, GRID_COLS, 2)[:, ::-1].copy()
    grid[..., 0] = width_px - 1 - grid[..., 0]
    return replace(
        look, rest_px=grid.reshape(MARKERS, 2), background=look.background[:, ::-1].copy()
    )


WIDTH_PX, HEIGHT_PX = 320, 240
_REACH_PX = 15  # half width of the patch around a dot; the mask has faded to 0.1 % there
_SIZE_PX = 2 * _REACH_PX
_FAR_PX2 = 1600.0  # upper limit of squared distances, so that exp does not overflow
_CONTRAST_SPREAD = 0.05  # relative spread of the darkness (real cores: 16 to 67 levels)
_FLECKS = 9  # light flecks per dot, which move with it
_FLECK_SIGMA_PX = 1.1

Float32 = NDArray[np.float32]


class DotRenderer:
    """Draws the 63 dots of one gel; ``rng`` determines darkness and flecks.

    ``mask``: (240, 320) of the last ``draw``, 0 = no paint. Buffers are reused, since allocating
    them for each frame costs more than the arithmetic.
    """

    def __init__(self, look: GelAppearance, rng: np.random.Generator) -> None:
        self._look = look
        self._drawn_px = np.full((MARKERS, 2), np.inf)
        self._slopes = _gradient_operators(look.rest_px)
        contrast = 1.0 - np.abs(_CONTRAST_SPREAD * rng.standard_normal(MARKERS))
        self._contrast = contrast.astype(np.float32)[:, None, None]
        angle = rng.uniform(0.0, 2.0 * np.pi, (MARKERS, _FLECKS))
        reach = 0.8 * look.radius_px * np.sqrt(rng.uniform(size=(MARKERS, _FLECKS)))
        self._fleck_u = (reach * np.cos(angle))[..., None].astype(np.float32)
        self._fleck_v = (reach * np.sin(angle))[..., None].astype(np.float32)
        self._fleck_height = rng.uniform(0.05, 0.45, (MARKERS, _FLECKS, 1)).astype(np.float32)
        area = 2.0 * np.pi * _FLECK_SIGMA_PX**2 / (np.pi * look.radius_px**2)
        mean = area * self._fleck_height.sum(axis=1, keepdims=True)
        self._paint_level = np.float32(1.0) + np.asarray(mean, dtype=np.float32)
        self._patches = np.empty((MARKERS, _SIZE_PX, _SIZE_PX), dtype=np.float32)
        self._flecks = np.empty_like(self._patches)
        # The margin contains parts outside of the image.
        shape = (HEIGHT_PX + 2 * _SIZE_PX, WIDTH_PX + 2 * _SIZE_PX)
        self._canvas = np.zeros(shape, dtype=np.float32)
        self.mask = self._canvas[_SIZE_PX:-_SIZE_PX, _SIZE_PX:-_SIZE_PX]

    def draw(self, displacement_px: FloatArray) -> bool:
        """Draw the dots at rest + ``displacement_px`` (63, 2) into ``mask``.

        Returns True if the mask changed.
        """
        if np.array_equal(displacement_px, self._drawn_px):
            return False
        self._drawn_px = displacement_px.copy()
        centre_px = self._look.rest_px + displacement_px
        corner = np.floor(centre_px).astype(np.intp) - _REACH_PX + 1
        steps = np.arange(_SIZE_PX, dtype=np.float32)
        first = (corner - centre_px).astype(np.float32)
        dx, dy = first[:, :1] + steps, first[:, 1:] + steps
        self._draw_discs(dx, dy, displacement_px)
        self._patches *= self._paint(dx, dy)
        self._canvas.fill(0.0)
        # Dots outside of the image are drawn on the margin.
        place = np.clip(corner + _SIZE_PX, 0, _LAST_CORNER).tolist()
        for (u, v), patch in zip(place, self._patches, strict=True):
            there = self._canvas[v : v + _SIZE_PX, u : u + _SIZE_PX]
            cv2.max(there, patch, there)
        return True

    def _draw_discs(self, dx: Float32, dy: Float32, displacement_px: FloatArray) -> None:
        """Fill the patches with discs; ``dx``, ``dy`` (63, n): px from the centres."""
        look, mask = self._look, self._patches
        a, b, c = _quadratic_form(self._slopes, displacement_px)
        np.multiply((2.0 * b * dy)[:, :, None], dx[:, None, :], out=mask)
        mask += (a * dx * dx)[:, None, :]
        mask += (c * dy * dy)[:, :, None]
        np.clip(mask, 0.0, _FAR_PX2, out=mask)
        np.sqrt(mask, out=mask)
        mask *= np.float32(1.0 / look.edge_px)
        mask -= np.float32(look.radius_px / look.edge_px)
        np.exp(mask, out=mask)
        mask += np.float32(1.0)
        np.divide(self._contrast, mask, out=mask)

    def _paint(self, dx: Float32, dy: Float32) -> Float32:
        """Return (63, n, n) darkness of the paint, 1 on average over a dot."""
        narrow = np.float32(-0.5 / _FLECK_SIGMA_PX**2)
        u = np.exp(narrow * np.square(dx[:, None, :] - self._fleck_u))
        v = np.exp(narrow * np.square(dy[:, None, :] - self._fleck_v)) * self._fleck_height
        np.matmul(v.swapaxes(1, 2), u, out=self._flecks)
        np.subtract(self._paint_level, self._flecks, out=self._flecks)
        return self._flecks


_LAST_CORNER = (WIDTH_PX + _SIZE_PX, HEIGHT_PX + _SIZE_PX)


def _gradient_operators(rest_px: FloatArray) -> FloatArray:
    """Return (2, 63, 63): maps a field on the grid to its slopes along u and v, per px."""
    rest = rest_px.reshape(GRID_ROWS, GRID_COLS, 2)
    units = np.eye(MARKERS).reshape(GRID_ROWS, GRID_COLS, MARKERS)
    along_u = np.asarray(np.gradient(units, float(np.mean(np.diff(rest[..., 0], axis=1))), axis=1))
    along_v = np.asarray(np.gradient(units, float(np.mean(np.diff(rest[..., 1], axis=0))), axis=0))
    return np.stack([along_u.reshape(MARKERS, MARKERS), along_v.reshape(MARKERS, MARKERS)])


def _quadratic_form(
    slopes: FloatArray, displacement_px: FloatArray
) -> tuple[Float32, Float32, Float32]:
    """Return a, b, c (63, 1) of |A p|² = a x² + 2 b x y + c y² with A the inverse of I + ∂d/∂p."""
    along_u, along_v = slopes @ displacement_px
    stretch_u, stretch_v = 1.0 + along_u[:, 0], 1.0 + along_v[:, 1]
    cross_u, cross_v = along_u[:, 1], along_v[:, 0]
    # Keep the dot finite at a fold of the gel (determinant near zero).
    square = np.maximum(stretch_u * stretch_v - cross_u * cross_v, 0.3) ** 2
    a = (stretch_v**2 + cross_u**2) / square
    b = -(stretch_v * cross_v + stretch_u * cross_u) / square
    c = (stretch_u**2 + cross_v**2) / square
    form = np.stack([a, b, c]).astype(np.float32)[..., None]
    return form[0], form[1], form[2]


SMEAR_RADIUS_PX = 13.0
# Offset (u, v) in px of a dot's shadow in B, G, R: the lights are on three sides.
_FRINGE = ((0, -4), (-4, 0), (0, 4))
_FRINGE_DEPTH = 0.5
_FRINGE_PX = 4
_BANK_FACTOR = 2

Develop = Callable[[], ImageArray]
Smear = tuple[slice, slice, Float32]  # rows and columns that a smear covers, and coverage (0..1)


class TactileRenderer:
    """Renders the images of one finger. Equal seeds and calls of ``expose`` give equal bytes.

    ``still_px``: motion of dots up to which they are drawn where they were.
    """

    def __init__(self, look: GelAppearance, seed: int, still_px: float = 0.0) -> None:
        self.look = look
        fixed = np.random.default_rng([seed, 1])
        self._draws = np.random.default_rng([seed, 2])
        # Fixed grain: a Gaussian pattern of correlation 1 px.
        white = fixed.standard_normal((HEIGHT_PX, WIDTH_PX, 3), dtype=np.float32)
        grain = np.asarray(cv2.GaussianBlur(white, (0, 0), 1.0), dtype=np.float32)
        grain *= np.float32(look.grain / float(grain.std()))
        self._back = np.ascontiguousarray(grain.transpose(2, 0, 1))
        self._back += _background(look.background.tobytes(), look.background.shape)
        self._to_core = look.core.astype(np.float32)[:, None, None] - self._back
        self._dots = DotRenderer(look, fixed)
        self._still_px, self._placed_px = still_px, np.full((MARKERS, 2), np.inf)
        self._bank = _noise_bank(json.dumps(fixed.bit_generator.state), look.noise)
        margin = 2 * _FRINGE_PX
        shadow = np.zeros((HEIGHT_PX + margin, WIDTH_PX + margin), dtype=np.float32)
        self._shadow = _shifted_view(shadow, 0, 0)
        self._fringes = [_shifted_view(shadow, du, dv) for du, dv in _FRINGE]
        self._shaded = np.empty((3, HEIGHT_PX, WIDTH_PX), dtype=np.float32)
        self._smeared = False
        self._developing = threading.Lock()
        self._plane = np.empty((HEIGHT_PX, WIDTH_PX), dtype=np.float32)
        self._levels = [np.empty((HEIGHT_PX, WIDTH_PX), dtype=np.uint8) for _ in range(3)]

    def render(self, displacement_px: FloatArray, hidden: NDArray[np.bool_]) -> ImageArray:
        """Return the image for ``displacement_px`` (63, 2); smears cover ``hidden`` dots (63,)."""
        return self.expose(displacement_px, hidden)()

    def expose(self, displacement_px: FloatArray, hidden: NDArray[np.bool_]) -> Develop:
        """Return a function that renders the image, from any thread."""
        if np.abs(displacement_px - self._placed_px).max() > self._still_px:
            self._placed_px = displacement_px.copy()
        covered_px = self.look.rest_px[hidden] + displacement_px[hidden]
        smears = [smear for centre_px in covered_px if (smear := _smear(centre_px))]
        rows = self._draws.integers(0, (_BANK_FACTOR - 1) * HEIGHT_PX, 3).tolist()
        columns = self._draws.integers(0, (_BANK_FACTOR - 1) * WIDTH_PX, 3).tolist()
        noise = [
            plane[row : row + HEIGHT_PX, column : column + WIDTH_PX]
            for plane, row, column in zip(self._bank, rows, columns, strict=True)
        ]
        return partial(self._develop, self._placed_px, smears, noise)

    def _develop(
        self, placed_px: FloatArray, smears: list[Smear], noise: list[Float32]
    ) -> ImageArray:
        with self._developing:
            changed = self._dots.draw(placed_px)
            if changed:
                np.multiply(self._dots.mask, np.float32(_FRINGE_DEPTH), out=self._shadow)
            fresh, self._smeared = changed or bool(smears) or self._smeared, bool(smears)
            for channel, grain in enumerate(noise):
                if fresh:
                    self._shade(channel, smears)
                cv2.add(self._shaded[channel], grain, self._plane)
                # Rounds and saturates in one pass; the absolute value has no effect on levels.
                cv2.convertScaleAbs(self._plane, self._levels[channel])
            return np.asarray(cv2.merge(self._levels), dtype=np.uint8)

    def _shade(self, channel: int, smears: list[Smear]) -> None:
        """Draw dots, their coloured shadows and smears over the background of a colour."""
        plane = self._shaded[channel]
        # OpenCV processes windows of larger arrays in half the time.
        cv2.max(self._dots.mask, self._fringes[channel], plane)
        np.multiply(self._to_core[channel], plane, out=plane)
        plane += self._back[channel]
        for rows, columns, cover in smears:
            there = plane[rows, columns]
            there += cover * (np.float32(self.look.smear[channel]) - there)


def _shifted_view(wide: Float32, du: int, dv: int) -> Float32:
    """Return the image within ``wide``, which has a margin, shifted by (du, dv)."""
    u, v = _FRINGE_PX - du, _FRINGE_PX - dv
    return wide[v : v + HEIGHT_PX, u : u + WIDTH_PX]


def _smear(centre_px: FloatArray) -> Smear | None:
    """Return the area of a smear at ``centre_px`` (2,), None outside of the image."""
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

    Cached between scenes, since the blur is slow.
    """
    table = np.frombuffer(colours).reshape(shape).astype(np.float32)
    large = cv2.resize(table, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    smooth = cv2.GaussianBlur(large, (0, 0), 20.0, borderType=cv2.BORDER_REPLICATE)
    planes = np.ascontiguousarray(np.asarray(smooth, dtype=np.float32).transpose(2, 0, 1))
    read_only(planes)
    return planes


@lru_cache(maxsize=2)
def _noise_bank(state: str, deviation: float) -> Float32:
    """Return (3, 480, 640) noise drawn by a generator in ``state``.

    Cached for the fingers of one scene, so that a repeated seed starts sooner; each takes 4 MB.
    """
    draws = np.random.Generator(np.random.PCG64())
    draws.bit_generator.state = json.loads(state)
    shape = (3, _BANK_FACTOR * HEIGHT_PX, _BANK_FACTOR * WIDTH_PX)
    bank = draws.standard_normal(shape, dtype=np.float32)
    bank *= np.float32(deviation)
    read_only(bank)
    return bank


@dataclass(frozen=True, slots=True)
class Exposure:
    """Number and time of one image; gaps in the numbers are lost frames.

    ``develop`` returns the image (240, 320, 3), BGR.
    """

    sequence: int
    t_us: int
    develop: Develop


@dataclass(frozen=True, slots=True)
class MarkerMotion:
    """Markers of one finger over a cycle: (63, 2) px at its start and end, and (2,) bias."""

    before_px: FloatArray
    after_px: FloatArray
    bias_px: FloatArray


class FingerCamera:
    """Exposes at the camera rate with jitter and drops; adds drift, bias and smears."""

    def __init__(self, settings: TactileSettings, optics: TactileRenderer, seed: int) -> None:
        self._settings, self._optics = settings, optics
        self._rng = np.random.default_rng([seed, 3])
        self._period_us = 1e6 / settings.rate_hz
        self._phase_us = float(self._rng.uniform(0.0, self._period_us))
        self._next, self._due_us = 0, 0
        self._last_us = 0
        self._drift_px = np.zeros(2)
        self._hidden_frames = np.zeros(MARKERS, dtype=np.intp)
        mean_length = 0.5 * (1 + settings.lost_frames)
        self._start_share = settings.lost_share / mean_length
        self._aim()

    def shots(
        self, start_us: int, end_us: int, sight: MarkerMotion, *, watched: bool = True
    ) -> list[Exposure]:
        """Return the images exposed in ``start_us < t <= end_us``; none unless ``watched``."""
        taken: list[Exposure] = []
        while self._due_us <= end_us:
            t_us, sequence = self._due_us, self._next
            self._next += 1
            self._aim()
            hidden = self._step_noise(t_us)
            dropped = self._rng.random() < self._settings.drop_share
            if dropped or t_us <= start_us or not watched:
                continue
            share = (t_us - start_us) / (end_us - start_us)
            field = sight.before_px + share * (sight.after_px - sight.before_px)
            field = field + sight.bias_px + self._drift_px
            taken.append(Exposure(sequence, t_us, self._optics.expose(field, hidden)))
        return taken

    def _aim(self) -> None:
        jitter = 1e6 * self._settings.jitter_s * self._rng.uniform(-1.0, 1.0)
        due = round(self._phase_us + self._next * self._period_us + jitter)
        self._due_us = max(due, self._due_us + 1)

    def _step_noise(self, t_us: int) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Advance drift and losses to ``t_us``; return the covered markers (63,)."""
        gap_s = max(t_us - self._last_us, 0) * 1e-6
        self._last_us = t_us
        walk = self._settings.drift_px_sqrt_s * np.sqrt(gap_s)
        self._drift_px = self._drift_px + walk * self._rng.standard_normal(2)
        self._hidden_frames = np.maximum(self._hidden_frames - 1, 0)
        begins = self._rng.random(MARKERS) < self._start_share
        lengths = self._rng.integers(1, self._settings.lost_frames + 1, MARKERS)
        self._hidden_frames = np.where(begins, lengths, self._hidden_frames)
        return np.asarray(self._hidden_frames > 0)
