"""Figures of marker tracking, on the real videos in tests/data and on known truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tests.backend.sensing.known_truth import known_truth
from tests.bench.registry import Figure, figure
from touchdown.backend.cli.track import track_images
from touchdown.backend.core.values import MARKERS, MarkerState

GELSIGHT = Path(__file__).resolve().parents[1] / "data" / "gelsight"
SMALL_DOTS = (
    GELSIGHT / "artificial_strawberry_exp2_camera_2.avi",
    GELSIGHT / "plug_3D_exp3_camera_0.avi",
)
"""Other gels: recognised and named by the tracker, not tracked."""


@figure("tracking")
def real_gels() -> list[Figure]:
    """Speed, and what is seen on real videos and pictures."""
    ms: list[float] = []
    whole_at_start, seen = [], []
    cv2.setNumThreads(1)
    for path in sorted({*GELSIGHT.glob("*.avi"), *GELSIGHT.glob("*.png")} - set(SMALL_DOTS)):
        for index, tracked in enumerate(track_images(path)):
            count = int(np.sum(tracked.field.state == MarkerState.SEEN))
            if index == 0:
                whole_at_start.append(count == MARKERS)
            else:
                ms.append(tracked.ms)
            seen.append(count / MARKERS)
    median, share = float(np.median(ms)), 100 * float(np.mean(seen))
    files = f"{sum(whole_at_start)} of {len(whole_at_start)}"
    return [
        Figure("tracker, median per frame, one thread", median, "ms", "<= 1 (must 2)", median <= 2),
        Figure("files with 63/63 on frame 0", files, "", "all", all(whole_at_start)),
        Figure("markers seen, all frames", share, "%", ">= 99", share >= 99, "covered ones count"),
    ]


@figure("tracking")
def truth_that_is_known() -> list[Figure]:
    """Errors against drawn dots, by amplitude and fault."""
    figures = []
    for case, found in known_truth().items():
        limit = 0.10 if case.fault in ("flick", "occl") else 0.05 if case.amplitude == 6 else 0.08
        name = f"known truth {case.amplitude:.0f} px {case.fault}, rms of seen"
        ok = found.rms_seen <= limit and found.wrong == 0 and found.lost == 0
        note = f"off by >= 10 px: {found.wrong}, lost: {found.lost}"
        figures.append(Figure(name, float(found.rms_seen), "px", f"<= {limit}", ok, note))
    return figures
