"""The trainings that were made on a dataset, read from their folders."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from backend.catalogue.run_folder import METRICS, RUNS, About, is_alive, read_about
from backend.core.faults import InputError
from backend.learning.checkpoint import Card, load_card
from backend.learning.metrics import ReliabilityBin

KIND = "train"
MODEL, RESUME, RELIABILITY = "model.safetensors", "model.resume.safetensors", "reliability.jsonl"
UNFINISHED = ("cancelled", "failed", "interrupted")

Curve = tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class TrainingRun:
    """One training. ``curves``: (epoch, value) by metric; ``card`` of the model if it was made.

    ``state`` is that of ``about``, but a run whose process is gone is interrupted.
    """

    folder: Path
    about: About
    state: str
    curves: Mapping[str, Curve] = field(default_factory=dict)
    reliability: Mapping[int, tuple[ReliabilityBin, ...]] = field(default_factory=dict)
    card: Card | None = None
    can_resume: bool = False

    @property
    def uuid(self) -> str:
        """Id of the run."""
        return self.about.uuid

    @property
    def model(self) -> Path:
        """Where the weights are once the run has finished."""
        return self.folder / MODEL

    @property
    def best_epoch(self) -> int:
        """Epoch of the lowest validation loss; 0 before the first."""
        losses = self.curves.get("validation_loss", ())
        return min(losses, key=lambda at: at[1])[0] if losses else 0

    def value(self, name: str, epoch: int) -> float:
        """Return a metric at an epoch, NaN where there is none."""
        return dict(self.curves.get(name, ())).get(epoch, math.nan)


def training_runs(data: Path) -> list[TrainingRun]:
    """Return the trainings on ``data``, the newest first; a folder that is none is passed over."""
    runs = data / RUNS
    folders = (
        sorted((p for p in runs.iterdir() if p.is_dir()), reverse=True) if runs.is_dir() else []
    )
    found = []
    for folder in folders:
        try:
            run = read_training_run(folder)
        except InputError:
            continue
        if run.about.kind == KIND:
            found.append(run)
    return sorted(found, key=lambda run: run.about.started_ns, reverse=True)


def read_training_run(folder: Path) -> TrainingRun:
    """Read one run; raises ``InputError`` if its ``run.json`` cannot be read."""
    about = read_about(folder)
    state: str = about.state
    if state == "running" and not is_alive(folder):
        state = "interrupted"
    made = TrainingRun(folder, about, state, _curves(folder / METRICS), _bins(folder / RELIABILITY))
    if state == "finished":
        return replace(made, card=_card(folder / MODEL))
    return replace(made, can_resume=state in UNFINISHED and (folder / RESUME).is_file())


def _card(model: Path) -> Card | None:
    try:
        return load_card(model)
    except InputError:
        return None


def _curves(path: Path) -> dict[str, Curve]:
    curves: dict[str, dict[int, float]] = {}

    def take(line: Mapping[str, Any]) -> None:
        value = math.nan if line["value"] is None else float(line["value"])
        curves.setdefault(str(line["name"]), {})[int(line["step"])] = value

    _read_lines(path, take)
    return {name: tuple(sorted(values.items())) for name, values in curves.items()}


def _bins(path: Path) -> dict[int, tuple[ReliabilityBin, ...]]:
    found: dict[int, tuple[ReliabilityBin, ...]] = {}

    def take(line: Mapping[str, Any]) -> None:
        bins = tuple((float(p), float(share), int(n)) for p, share, n in line["bins"])
        found[int(line["epoch"])] = bins

    _read_lines(path, take)
    return found


def _read_lines(path: Path, take: Callable[[Mapping[str, Any]], None]) -> None:
    """Give each whole line to ``take``; one that a crash tore is passed over."""
    try:
        content = path.read_bytes()
    except OSError:
        return
    for raw in content.splitlines():
        try:
            take(json.loads(raw))
        except (ValueError, KeyError, TypeError):
            continue
