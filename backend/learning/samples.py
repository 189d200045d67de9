"""Predictions of a new model beside the truth, from the best to the worst, kept for a look."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.core.flow import FloatArray
from backend.dataset.rows import TrainingRows, patch_bits, patch_hex
from backend.learning.metrics import LEVEL, iou, point_accuracy

SAMPLES = "samples.json"
MOST = 12
MAX_BYTES = 10_000_000


@dataclass(frozen=True, slots=True)
class Sample:
    """One held-out episode: ``probability`` and ``truth`` over the face points, (N,) each."""

    episode: str
    bottom: str
    offset_mm: tuple[float, float]
    iou: float
    probability: FloatArray
    truth: NDArray[np.bool_]


def choose_samples(
    rows: TrainingRows, held_out: NDArray[np.int64], probability: NDArray[np.floating]
) -> list[Sample]:
    """Return up to 12 held-out episodes, evenly from the best to the worst IoU."""
    each = [iou(probability[k : k + 1] > LEVEL, rows.patch[i : i + 1])
            for k, i in enumerate(held_out.tolist())]  # fmt: skip
    order = np.argsort([-v for v in each], kind="stable")
    places = np.unique(np.linspace(0, len(order) - 1, min(MOST, len(order))).round().astype(int))
    found = []
    for k in order[places].tolist():
        i = int(held_out[k])
        x_mm, y_mm = rows.offset_mm[i].tolist()
        episode = str(rows.labels[i].get("episode", i))
        found.append(
            Sample(episode, rows.bottom[i], (x_mm, y_mm), each[k], probability[k], rows.patch[i])
        )
    return found


def bottom_figures(
    rows: TrainingRows, held_out: NDArray[np.int64], probability: NDArray[np.floating]
) -> dict[str, dict[str, float]]:
    """Return episodes, IoU and point accuracy of the validation side per bottom."""
    bottoms = np.array([rows.bottom[i] for i in held_out.tolist()])
    predicted, truth = probability > LEVEL, rows.patch[held_out]
    found = {}
    for name in sorted(set(bottoms.tolist())):
        at = bottoms == name
        found[name] = {
            "episodes": int(at.sum()),
            "iou": round(iou(predicted[at], truth[at]), 4),
            "point_accuracy": round(point_accuracy(predicted[at], truth[at]), 4),
        }
    return found


def save_samples(folder: Path, samples: list[Sample]) -> None:
    """Write ``samples.json``."""
    lines = [
        {
            "episode": s.episode,
            "bottom": s.bottom,
            "offset_mm": list(s.offset_mm),
            "iou": round(s.iou, 4),
            "probability": [round(float(p), 4) for p in s.probability],
            "truth": patch_hex(s.truth),
        }
        for s in samples
    ]
    write_atomically(folder / SAMPLES, json.dumps({"version": 1, "samples": lines}).encode())


def load_samples(folder: Path) -> list[Sample]:
    """Read ``samples.json``; none where a training did not get so far. Raises ``InputError``."""
    path = folder / SAMPLES
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError("the file is too large")
        content = json.loads(path.read_bytes())
        return [_sample(line) for line in content["samples"]]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError("The sample predictions cannot be read.", str(path), "Train again.") from (
            error
        )


def _sample(line: dict[str, Any]) -> Sample:
    probability = np.asarray(line["probability"], dtype=np.float64)
    x_mm, y_mm = line["offset_mm"]
    return Sample(
        str(line["episode"]),
        str(line["bottom"]),
        (float(x_mm), float(y_mm)),
        float(line["iou"]),
        probability,
        patch_bits(line["truth"], probability.size),
    )
