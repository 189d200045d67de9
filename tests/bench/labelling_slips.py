"""How many slips in the grasp are badged, and how many clean probes: by the page's own rule."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.bench.registry import Figure, figure

PROBES, PER_GRIP, EVERY = 126, 3, 3
"""In every third grip the piece sits 1 to 3 mm off its place along the jaws."""


@figure("labelling")
def slips() -> list[Figure]:
    """Collect on the simulated devices with injected slips, then judge each recorded label."""
    from touchdown.backend.annotations.dataset import Dataset

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "dataset"
        with mock.patch("os.fsync"), Dataset.open(folder, person="bench") as dataset:
            slipped_at_s = _collect(dataset)
            judged = _judged(dataset, slipped_at_s)
    hits = [badged for slipped, badged in judged if slipped]
    false = [badged for slipped, badged in judged if not slipped]
    return [
        _row("slips of 1 to 3 mm that are badged", hits, ">= 95", low=95.0, high=100.0),
        _row("clean probes that are badged", false, "<= 5", low=0.0, high=5.0),
    ]


def _row(name: str, badged: list[bool], target: str, *, low: float, high: float) -> Figure:
    if not badged:
        return Figure(name, None, "%", target, None, "no such probe was collected")
    share = 100 * sum(badged) / len(badged)
    note = f"{sum(badged)} of {len(badged)} probes"
    return Figure(name, share, "%", target, low <= share <= high, note)


Taken = tuple[int, float]
"""Mounting (0, 1, ...) and time of a picture: the clock begins anew with every mounting."""


def _collect(dataset: Any) -> dict[Taken, bool]:
    """Return for each picture whether the piece had slipped."""
    from touchdown.backend.bench.assembly import simulated_session
    from touchdown.backend.runs.recorder import RecordingOptions
    from touchdown.backend.runs.requests import CollectRequest
    from touchdown.backend.simulation import gripper
    from touchdown.backend.simulation.devices.bench import SimulatedBench

    rng, grips, slipped = np.random.default_rng(5), [0], dict[Taken, bool]()
    last: Taken = (0, 0.0)
    draw, picture = gripper.draw_gripping, SimulatedBench.scene_picture

    def drawn(*given: Any) -> Any:
        grip = draw(*given)
        grips[0] += 1
        if grips[0] % EVERY:
            return grip
        x_mm, z_mm = grip.grasp_offset_mm
        x_mm += float(rng.choice([-1, 1]) * rng.uniform(1, 3))
        return dataclasses.replace(grip, grasp_offset_mm=(x_mm, z_mm))

    def seen(bench: SimulatedBench) -> Any:
        nonlocal last
        at_s, now = round(bench.clock.now_s(), 6), grips[0] % EVERY == 0
        last = (last[0] + (at_s < last[1]), at_s)
        if slipped.setdefault(last, now) is not now:
            raise RuntimeError("two pictures at one time: nobody could tell which slipped")
        return picture(bench)

    with (
        mock.patch.object(gripper, "draw_gripping", drawn),
        mock.patch.object(SimulatedBench, "scene_picture", seen),
    ):
        session = simulated_session(keep=RecordingOptions(None))
        session.dataset = dataset
        session.run(
            CollectRequest(
                count=PROBES, person="bench", probes_per_grip=PER_GRIP, grips_per_mounting=10
            )
        )
        session.close()
    return slipped


def _judged(dataset: Any, slipped: dict[Taken, bool]) -> list[tuple[bool, bool]]:
    """Return (slipped, badged) of each probe that was no refused observation."""
    from touchdown.app.label.evidence import evidence_badges
    from touchdown.app.shell.datasets import ModelPrelabeller, model_path_in_use
    from touchdown.app.shell.label_items import LabelDraft, item_reader
    from touchdown.backend.geometry.pieces import load_pieces

    read = item_reader(dataset, ModelPrelabeller(load_pieces(), model_path_in_use), lambda: None)
    judged, mountings = [], dict[str, int]()
    for entry in dataset.episodes():
        mounting = mountings.setdefault(entry.mounting_id, len(mountings))
        if entry.quality.accepted:
            item = read(entry.uuid)
            assert item.episode.recording is not None
            at_s = round(item.episode.recording.scene[0].t_s, 6)
            badge = evidence_badges(LabelDraft.of(dataset.labels.head(entry.uuid)), item)
            judged.append((slipped[mounting, at_s], bool(badge)))
    return judged
