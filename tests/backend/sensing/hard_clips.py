"""Twenty hard clips with known truth, rendered from real gels.

A frame of a real clip is warped by a known field, as a pyramid pressed in beside the border would
do: the gel is pushed outwards and sheared around a point, and the whole image may turn. Flanks of
the pyramid take the colour of their light and darken. Glare, contrast, cover, motion blur, noise
and MPEG-4 compression follow. Equal clips on every call; about 2 s a clip.

Markers are found in the unwarped frame by the plain detector of ``known_truth`` and carried along
by the field. A marker counts as visible if its whole dot lies in the image, without cover and with
its middle at least ``CONTRAST`` darker than the ring around it; as hidden if it is covered, or its
centre is outside. The remaining ones, partly visible, are not scored.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from tests.backend.sensing.known_truth import GELSIGHT, plain_detector, row_major
from touchdown.backend.core import MarkerState, TactileFrame
from touchdown.backend.sensing import MarkerTracker, read_pictures
from touchdown.backend.sensing.detector import Detector

AVOCADO, BOX, DRIVER, PLUG, BERRY = (
    f"{name}.avi"
    for name in (
        "avocado_real_exp1_camera_2", "blue_box_exp2_camera_2", "screw_driver_red_exp1_camera_2",
        "plug_3D_exp3_camera_2", "artificial_strawberry_exp2_camera_0",
    )
)  # fmt: skip
REST = "nocontact_train_sensor.png"
WIDTH, HEIGHT = 320, 240
FRAMES = 100
RADIUS = 9.0  # px, of a whole dot
CONTRAST = 0.2
RIGHT_PX, WRONG_PX = 1.0, 1.5
# Directions of the lights: blue from above, green from the left, red from the lower right.
LIGHTS = np.array([[0.1, -1.0], [-1.0, 0.2], [0.7, 0.7]])


@dataclass(frozen=True)
class HardClip:
    """Recipe of one clip; lengths in px of the image, times in frames."""

    name: str
    base: str  # real clip or picture
    at: tuple[float, float]  # middle of the pyramid
    push: float  # largest outward displacement
    shear: tuple[float, float] = (0.0, 0.0)  # displacement of the middle
    reach: float = 55.0  # of the field
    rise: int = 40  # frames from rest to the full press
    start: int = 0  # first frame of the real clip
    turn_deg: float = 0.0
    flank: float = 0.6  # colour of the flanks of the pyramid
    shadow: float = 0.35  # their darkening
    half_width: float = 34.0  # of the pyramid
    glare: tuple[float, float, float] | None = None  # u, v and levels of a bright area
    contrast: float = 1.0
    dim: float = 0.0  # share of light lost towards the corner nearest to ``at``
    cover: tuple[int, int, float] | None = None  # first and last frame, and radius about ``at``
    blur: int = 1  # exposures averaged
    pressed: bool = False  # already pressed in the first frame


CLIPS = (
    HardClip("corner, slow", REST, (276, 200), 7, (8, 6)),
    HardClip("corner, strong", AVOCADO, (276, 36), 9, (-12, 10), 60, 30),
    HardClip("corner, fast onset", BOX, (36, 200), 8, (10, -8), rise=3),
    HardClip("left border", DRIVER, (20, 120), 8, (0, 12), rise=25),
    HardClip("bottom border", PLUG, (170, 226), 8, (12, 0), rise=60),
    HardClip("top border, outwards", BERRY, (160, 40), 6, (0, -14), rise=30),
    HardClip("pressed at the start", BOX, (270, 196), 9, (10, 8), start=150, pressed=True),
    HardClip("pressed, dark corner", DRIVER, (276, 200), 8, (8, 10), dim=0.6, pressed=True),
    HardClip("dark corner", AVOCADO, (40, 36), 8, (10, 6), rise=30, dim=0.6),
    HardClip("glare beside the press", REST, (270, 190), 8, (8, 8), glare=(300, 150, 120)),
    HardClip("glare in the corner", PLUG, (250, 50), 8, (-10, 6), 60, 30, glare=(310, 20, 120)),
    HardClip("low contrast", DRIVER, (50, 190), 8, (12, -8), rise=30, contrast=0.4),
    HardClip("low contrast, dim", BERRY, (270, 50), 7, (-10, 8), contrast=0.45, dim=0.5),
    HardClip("motion blur, fast", AVOCADO, (270, 190), 9, (12, 8), rise=4, blur=5),
    HardClip("turned by 12 degrees", BOX, (262, 180), 6, (6, 6), rise=40, turn_deg=12.0),
    HardClip("turned by -10 degrees, fast", PLUG, (60, 60), 6, (8, 0), rise=8, turn_deg=-10.0),
    HardClip("covered corner", REST, (276, 200), 7, (8, 6), cover=(30, 75, 52)),
    HardClip("covered corner, sheared", DRIVER, (40, 40), 8, (10, 8), cover=(10, 90, 48)),
    HardClip("steep flanks", PLUG, (264, 190), 8, (10, 6), flank=1.2, shadow=0.6, half_width=26),
    HardClip("compressed hard", BERRY, (262, 192), 12, (6, 6), 70, 20, flank=1.0, shadow=0.5),
)  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """Frames (n, 240, 320, 3), true places (n, 63, 2), and (n, 63) visible and hidden markers."""

    images: list[np.ndarray]
    truth: np.ndarray
    visible: np.ndarray
    hidden: np.ndarray


def press_levels(clip: HardClip) -> np.ndarray:
    """Return the strength of the press, 0 to 1, in each frame."""
    up = np.linspace(0.0, 1.0, clip.rise + 1)
    if clip.pressed:
        up = np.ones(1)
    down = np.linspace(1.0, 0.0, 25)
    held = np.ones(max(FRAMES - len(up) - len(down) - 5, 0))
    return np.concatenate([up, held, down, np.zeros(FRAMES)])[:FRAMES]


def field(clip: HardClip, q: np.ndarray, level: float) -> np.ndarray:
    """Return U(q) at strength ``level``: the value at ``q`` (..., 2) comes from q + U(q)."""
    away = q - np.array(clip.at)
    bump = np.exp(-np.sum(away**2, axis=-1, keepdims=True) / clip.reach**2)
    # away / reach * bump is largest, exp(-1/2) / sqrt(2) = 0.43, at reach / sqrt(2).
    out = clip.push / 0.43 * away / clip.reach * bump + np.array(clip.shear) * bump
    turn = np.deg2rad(clip.turn_deg) * level
    middle = np.array([WIDTH, HEIGHT]) / 2
    back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return -level * out + (q - middle) @ back - (q - middle)


def carried(clip: HardClip, places: np.ndarray, level: float) -> np.ndarray:
    """Return the places (n, 2) after the warp: q + U(q) = p, by Newton steps."""
    q = places.copy()
    for _ in range(12):
        residual = q + field(clip, q, level) - places
        du, dv = (
            (field(clip, q + h, level) - field(clip, q - h, level)) / 2e-4
            for h in (np.array([1e-4, 0.0]), np.array([0.0, 1e-4]))
        )
        slope = np.stack([du, dv], axis=-1) + np.eye(2)
        q = q - np.linalg.solve(slope, residual[..., None])[..., 0]
    assert np.abs(q + field(clip, q, level) - places).max() < 1e-3, clip.name
    return q


@cache
def _grid() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).astype(float)


@cache
def _flanks(clip: HardClip) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colour of the flanks (240, 320, 3), their steepness and the dark corner (..., 1)."""
    away = np.abs(_grid() - np.array(clip.at))
    height = np.clip(clip.half_width - away.max(axis=-1), 0, None)
    smooth = cv2.GaussianBlur(height.astype(np.float32), (0, 0), 5.0)
    slope = np.stack([cv2.Sobel(smooth, cv2.CV_32F, *d, scale=1 / 8) for d in ((1, 0), (0, 1))], -1)
    steep = np.linalg.norm(slope, axis=-1)[..., None]
    corner = np.where(np.array(clip.at) > np.array([160, 120]), [WIDTH, HEIGHT], [0, 0])
    near = np.exp(-np.sum((_grid() - corner) ** 2, axis=-1) / 90.0**2)[..., None]
    return (slope @ LIGHTS.T).astype(np.float32), steep, (1 - clip.dim * near).astype(np.float32)


def _light(clip: HardClip, level: float) -> np.ndarray:
    """Return (240, 320, 3) factors: flanks of the pyramid and the dark corner."""
    colour, steep, corner = _flanks(clip)
    shade = 1 - np.float32(level * clip.shadow) * steep
    factor = (1 + np.float32(level * clip.flank) * colour) * shade
    return np.maximum(factor, np.float32(0.1)) * corner


def _base(clip: HardClip) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the real frames and the dots (63, 2) in each."""
    images = [f.image for f in read_pictures(GELSIGHT / clip.base)]
    images = images * FRAMES if len(images) == 1 else images[clip.start : clip.start + FRAMES]
    dots, known = [], {}
    detector = Detector()
    for image in images:
        if id(image) not in known:
            detector.look(image)
            plain = row_major(plain_detector(image))
            known[id(image)] = detector.refine(plain).position_px
        dots.append(known[id(image)])
    return images, dots


def render(clip: HardClip) -> Scene:
    """Return the frames of ``clip`` after MPEG-4 compression, and their truth."""
    rng = np.random.Generator(np.random.PCG64(len(clip.name)))
    images, dots = _base(clip)
    levels = press_levels(clip)
    shown, truth, visible, hidden = [], [], [], []
    grid = _grid()
    for k, (image, rest, level) in enumerate(zip(images, dots, levels, strict=True)):
        before = levels[max(k - 1, 0)]
        exposures = np.linspace(before, level, clip.blur + 1)[1:]
        frame = np.zeros((HEIGHT, WIDTH, 3), np.float32)
        for one in exposures:
            source = (grid + field(clip, grid, float(one))).astype(np.float32)
            moved = cv2.remap(
                image, source[..., 0], source[..., 1], cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REFLECT_101,
            )  # fmt: skip
            frame += moved * _light(clip, float(one)) / clip.blur
        place = carried(clip, rest, float(exposures.mean()))
        gone = (place < 0).any(axis=1) | (place > [WIDTH - 1, HEIGHT - 1]).any(axis=1)
        seen = ((place >= RADIUS) & (place <= [WIDTH - 1 - RADIUS, HEIGHT - 1 - RADIUS])).all(
            axis=1
        )
        if clip.glare is not None:
            u, v, bright = clip.glare
            bell = np.exp(-np.sum((grid - [u, v]) ** 2, axis=-1) / (2 * 18.0**2))[..., None]
            frame += (level * bright * bell).astype(np.float32)
        mean = frame.mean(axis=(0, 1))
        frame = mean + np.float32(clip.contrast) * (frame - mean)
        if clip.cover is not None and clip.cover[0] <= k <= clip.cover[1]:
            away = np.linalg.norm(grid - np.array(clip.at), axis=-1)[..., None]
            patch = (1 / (1 + np.exp((away - clip.cover[2]) / 1.5))).astype(np.float32)
            frame += patch * (np.float32([118, 112, 90]) - frame)
            apart = np.linalg.norm(place - np.array(clip.at), axis=1)
            gone |= apart < clip.cover[2] - 5
            seen &= apart > clip.cover[2] + RADIUS + 3
        frame += np.float32(1.5) * rng.standard_normal(frame.shape, np.float32)
        shown.append(np.clip(np.rint(frame), 0, 255).astype(np.uint8))
        truth.append(place)
        visible.append(seen & (_contrast(frame, place) >= CONTRAST))
        hidden.append(gone)
    return Scene(_compressed(shown), np.array(truth), np.array(visible), np.array(hidden))


def _contrast(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return (n,) the darkness of the middle of each dot, relative to the ring around it."""
    brightest = image.max(axis=2).astype(np.float32)
    ring = []
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    for radius in (3.0, 12.0):
        u = places[:, :1] + radius * np.cos(turn)
        v = places[:, 1:] + radius * np.sin(turn)
        values = cv2.remap(
            brightest, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        ring.append(np.median(values, axis=1))
    return 1.0 - ring[0] / np.maximum(ring[1], 1.0)


def _compressed(images: list[np.ndarray]) -> list[np.ndarray]:
    """Return the images after MPEG-4 coding."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "clip.avi")
        writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"FMP4"), 25.0, (WIDTH, HEIGHT))
        for image in images:
            writer.write(image)
        writer.release()
        return [np.asarray(frame.image) for frame in read_pictures(Path(path))]


@dataclass(frozen=True)
class HardScore:
    """Counts of markers and frames of one clip.

    ``seen``: visible ones reported as seen within 1 px; ``inferred``, ``lost``: visible ones
    reported so; ``false``: reported as seen over 1.5 px off, or hidden (also ``hidden``).
    ``unseen_at`` (63,): visible ones not seen within 1 px, by marker.
    """

    visible: int
    seen: int
    inferred: int
    lost: int
    false: int
    hidden: int
    unseen_at: np.ndarray


def score(scene: Scene) -> HardScore:
    """Track the frames of ``scene`` at 25 frames per second and compare with the truth."""
    tracker, found = MarkerTracker("left"), []
    for k, image in enumerate(scene.images):
        found.append(tracker.track(TactileFrame("left", k, k / 25, image)))
    off_px = np.linalg.norm(np.stack([f.position_px for f in found]) - scene.truth, axis=-1)
    state = np.stack([f.state for f in found])
    state[[f.quality == 0.0 for f in found]] = MarkerState.LOST
    reported = state == MarkerState.SEEN
    right = scene.visible & reported & (off_px <= RIGHT_PX)
    return HardScore(
        visible=int(scene.visible.sum()),
        seen=int(right.sum()),
        inferred=int((scene.visible & (state == MarkerState.INFERRED)).sum()),
        lost=int((scene.visible & (state == MarkerState.LOST)).sum()),
        false=int((reported & ((off_px > WRONG_PX) | scene.hidden)).sum()),
        hidden=int((reported & scene.hidden).sum()),
        unseen_at=np.asarray((scene.visible & ~right).sum(axis=0)),
    )
