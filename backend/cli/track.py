"""``touchdown track``: track the gel's markers in an image, a video or a folder of images."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.backend.cli.output import VerbOutput, check_output
from touchdown.backend.core import GRID_COLS, GRID_ROWS, InputError, MarkerState, RefusedError
from touchdown.backend.sensing import (
    DEFAULT_RATE_HZ,
    MIN_REST_FRAMES,
    OverlayVideo,
    TactileReference,
    TrackedImage,
    complete_fields,
    count_pictures,
    mean_reference,
    read_pictures,
    refuse_contact,
    take_reference,
    track_frames,
)
from touchdown.backend.simulation import load_gel_appearance, mirror_appearance

_GRID = f"{GRID_ROWS}x{GRID_COLS}"
_REST_FIX = {
    "contact": "Take pictures with nothing on the gel. If nothing touches it here, this sensor's "
    "own shape differs from the shipped one: name its no-contact pictures with --template.",
    "motion": "Take pictures of a gel at rest.",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("file", type=Path, help="image, video or folder of images")
    add("--reference", type=Path, help="rest images that displacements count from (default: first)")
    add("--template", type=Path, metavar="FILE", help="no-contact pictures of the same sensor that "
        "the reference is checked against (default: the large-dot gel that ships)")  # fmt: skip
    add("--overlay", type=Path, help="write a video with the markers drawn in")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Track and report; ``InputError`` for files or gels that cannot be tracked."""
    # Suppress messages of OpenCV; the error names file and fix.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    if args.template and not args.reference:
        fix = "Name the rest images: --reference."
        raise InputError("There is no reference to check.", "--template", fix)
    if args.overlay:
        check_output(args.overlay, ".mp4", args.file, args.reference, args.template)
    reference = rest_reference(args.reference, args.template) if args.reference else None
    tracked: list[TrackedImage] = []
    with ExitStack() as stack:
        overlay = None
        advance = stack.enter_context(screen.progress("Tracking", count_pictures(args.file)))
        for item in track_frames(read_pictures(args.file), reference, str(args.file)):
            tracked.append(item)
            if args.overlay and overlay is None:  # once there is a picture
                overlay = stack.enter_context(OverlayVideo(args.overlay, DEFAULT_RATE_HZ))
            if overlay is not None:
                overlay.add(item.frame, item.field)
            advance(len(tracked))
    _summarise(args.file, tracked, screen)
    screen.result({"grid": _GRID, "frames": [_as_json(item) for item in tracked]})
    return 0


def rest_reference(path: Path, template: Path | None = None) -> TactileReference:
    """Return the mean marker positions over the first ten images of ``path`` with all 63 markers.

    ``template``: no-contact images of this sensor; default is the shape of the shipped gel. Raises
    ``InputError`` if the gel moves or is in contact.
    """
    whole = complete_fields(read_pictures(path), str(path))
    if template is None:
        shapes = [load_gel_appearance().rest_px, mirror_appearance(load_gel_appearance()).rest_px]
    else:
        shapes = [
            mean_reference(complete_fields(read_pictures(template), str(template))).position_px
        ]
    try:
        rest = mean_reference(whole) if len(whole) < MIN_REST_FRAMES else take_reference(whole)
        refuse_contact(rest.position_px, shapes)
    except RefusedError as refused:
        raise InputError(refused.detail, str(path), _REST_FIX[refused.reason]) from refused
    return rest


def _as_json(item: TrackedImage) -> dict[str, object]:
    field = item.field
    markers = [
        {
            "row": index // GRID_COLS,
            "col": index % GRID_COLS,
            "x_px": round(float(place[0]), 4),
            "y_px": round(float(place[1]), 4),
            "dx_px": round(float(move[0]), 4),
            "dy_px": round(float(move[1]), 4),
            "state": MarkerState(int(state)).name.lower(),
        }
        for index, (place, move, state) in enumerate(
            zip(field.position_px, field.displacement_px, field.state, strict=True)
        )
    ]
    return {
        "index": field.sequence,
        "ms": round(item.ms, 4),
        "quality": round(field.quality, 4),
        "markers": markers,
    }


def _summarise(path: Path, tracked: list[TrackedImage], screen: VerbOutput) -> None:
    fields = [item.field for item in tracked]
    state = np.stack([field.state for field in fields])
    moved = np.stack([np.linalg.norm(field.displacement_px, axis=1) for field in fields])
    rows = {
        "markers seen": _share(state, MarkerState.SEEN),
        "inferred from neighbours": _share(state, MarkerState.INFERRED),
        "lost": _share(state, MarkerState.LOST),
        "largest displacement": f"{moved.max():.2f} px",
        "lowest frame quality": f"{min(field.quality for field in fields):.2f}",
        "median time per frame": f"{np.median([item.ms for item in tracked]):.2f} ms",
    }
    title = f"{path.name}: {len(fields)} frames, grid {_GRID}"
    screen.table(title, ("measure", "value"), *rows.items(), right=("value",))


def _share(state: NDArray[np.uint8], kind: MarkerState) -> str:
    return f"{100 * (state == kind).mean():.2f} %"
