"""Marker tracking of an image sequence, with the tracker of the live bench."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np

from touchdown.backend.core import (
    Finger,
    ImageArray,
    InputError,
    MarkerField,
    MarkerState,
    TactileFrame,
)
from touchdown.backend.sensing.picture_files import DEFAULT_RATE_HZ, resize_picture
from touchdown.backend.sensing.tracker import MarkerTracker
from touchdown.backend.sensing.zeroing import REST_FRAMES, TactileReference

_SEARCH_FRAMES = 25  # frames in which the grid must be recognised


@dataclass(frozen=True, slots=True)
class TrackedImage:
    """A frame, its markers, and the computing time of the tracker in ms."""

    frame: TactileFrame
    field: MarkerField
    ms: float


def track_markers(
    images: Iterable[ImageArray],
    reference: TactileReference | Iterable[ImageArray] | None = None,
    *,
    finger: Finger = "left",
    rate_hz: float = DEFAULT_RATE_HZ,
) -> list[MarkerField]:
    """Track the 63 gel markers through a sequence of images of one finger.

    Parameters
    ----------
    images
        Images in order of time: (H, W, 3) BGR or (H, W) grey, uint8, aspect ratio 4:3. Other sizes
        than 320 x 240 px are resized.
    reference
        Rest positions from which displacements are measured: a reference, or images of the gel at
        rest. By default the first image that shows the grid.
    finger
        Finger that the fields belong to.
    rate_hz
        Frame rate, which gives the time stamps of the fields. The tracker gives up markers that
        were not seen for 2 s.

    Returns
    -------
    list of MarkerField
        One field per image. Positions and displacements are in px of the 320 x 240 image, u to the
        right and v down. An image in which no marker is recognised has quality 0.

    Raises
    ------
    InputError
        If an image has another shape or type, or if no 7 x 9 grid is found in the first 25 images.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> def gel(shift_px):
    ...     image = np.full((240, 320), 200, np.uint8)
    ...     for row in range(7):
    ...         for col in range(9):
    ...             cv2.circle(image, (32 + 32 * col + shift_px, 24 + 32 * row), 7, 40, -1)
    ...     return image
    >>> fields = track_markers([gel(0), gel(1), gel(3)])
    >>> [f"{field.displacement_px[:, 0].mean():.1f}" for field in fields]
    ['0.0', '1.0', '3.0']
    >>> fields[-1].position_px.shape
    (63, 2)

    """
    if reference is not None and not isinstance(reference, TactileReference):
        rest = _as_frames(reference, finger, rate_hz, "reference")
        reference = mean_reference(complete_fields(rest, "reference"))
    frames = _as_frames(images, finger, rate_hz, "images")
    return [tracked.field for tracked in track_frames(frames, reference, "images")]


def track_frames(
    frames: Iterable[TactileFrame], reference: TactileReference | None, where: str
) -> Iterator[TrackedImage]:
    """Yield the markers of ``frames`` (one finger, in order of time).

    Without ``reference`` displacements count from the first frame that shows the grid. Raises
    ``InputError`` naming ``where`` if no 7 x 9 grid is recognised within the first second.
    """
    tracker: MarkerTracker | None = None
    located = False
    for count, frame in enumerate(frames, start=1):
        tracker = tracker or MarkerTracker(frame.finger, reference)
        start = time.perf_counter()
        field = tracker.track(frame)
        ms = 1e3 * (time.perf_counter() - start)
        if not located and field.quality > 0:
            located = True
            if reference is None:
                tracker.set_reference(mean_reference([field]))
        if not located and count >= _SEARCH_FRAMES:
            break
        yield TrackedImage(frame, field, ms)
    if not located:
        raise _grid_not_found(tracker, where)


def complete_fields(frames: Iterable[TactileFrame], where: str) -> list[MarkerField]:
    """Return the fields of the first ten frames that show all 63 markers, at least one.

    Raises ``InputError`` naming ``where`` if there is none.
    """
    tracker: MarkerTracker | None = None

    def fields() -> Iterator[MarkerField]:
        nonlocal tracker
        for frame in frames:
            tracker = tracker or MarkerTracker(frame.finger)
            yield tracker.track(frame)

    whole = list(islice((f for f in fields() if (f.state == MarkerState.SEEN).all()), REST_FRAMES))
    if not whole:
        raise _grid_not_found(tracker, where)
    return whole


def mean_reference(fields: list[MarkerField]) -> TactileReference:
    """Return the mean positions of ``fields`` (one or more), without checks of motion or contact.

    See ``take_reference`` for a checked reference.
    """
    places = np.stack([field.position_px for field in fields])
    noise = places.std(axis=0).mean(axis=1)
    return TactileReference(
        fields[-1].finger, fields[-1].t_s, places.mean(axis=0), noise, len(fields)
    )


def _as_frames(
    images: Iterable[ImageArray], finger: Finger, rate_hz: float, where: str
) -> Iterator[TactileFrame]:
    for number, image in enumerate(images):
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
            what = f"Image {number} has shape {image.shape} and type {image.dtype}."
            fix = "Give uint8 images of shape (H, W, 3), BGR, or (H, W), grey."
            raise InputError(what, where, fix)
        bgr = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
        picture = resize_picture(np.asarray(bgr, dtype=np.uint8), where)
        yield TactileFrame(finger, number, number / rate_hz, picture)


def _grid_not_found(tracker: MarkerTracker | None, where: str) -> InputError:
    found = tracker.grid.message if tracker is not None else "there are no images"
    return InputError(
        f"No 7x9 marker grid was recognised: {found}.",
        where,
        "Use pictures of a 7x9 large-dot gel with all dots in view at the start.",
    )
