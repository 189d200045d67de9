"""What Review hands out: the probes as a table, the file itself."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path

from PySide6.QtCore import QProcess

from app.review.timed import TimedTrial
from backend.core.files import write_atomically
from backend.objects.shapes import Outline

COLUMNS = (
    "trial", "seed", "probe", "decided_s", "x_mm", "y_mm", "verdict", "margin_mm", "action",
    "iou", "accuracy", "outcome", "episode",
)  # fmt: skip
VIEWER = "xdg-open"


def table_of(trials: Iterable[tuple[TimedTrial, Outline | None]]) -> str:
    """Return one line a probe as CSV, with the estimate against the truth where it is known.

    Each trial comes with the face of its bottom.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for trial, bottom in trials:
        writer.writerows(_rows(trial, bottom))
    return text.getvalue()


def _rows(trial: TimedTrial, bottom: Outline | None) -> Iterator[tuple[object, ...]]:
    whole = trial.story(float("inf"))
    outcome = "" if whole.finished is None else whole.finished.outcome.name.lower()
    episodes = {fact.probe: fact.episode.episode_id for fact in trial.episodes()}
    for look in whole.probes:
        at_s = trial.decided_s(look.probe)
        score, s = trial.score(at_s, bottom), look.stability
        x, y = look.offset_mm or (None, None)
        yield (
            whole.trial, whole.seed, look.probe, f"{at_s:.3f}", _mm(x), _mm(y),
            "" if s is None else "stable" if s.stable else "unstable",
            "" if s is None else _mm(s.margin_mm),
            "" if look.action is None else look.action.kind,
            "" if score is None else f"{score.iou:.4f}",
            "" if score is None else f"{score.accuracy:.4f}",
            outcome, episodes.get(look.probe, ""),
        )  # fmt: skip


def export_table(text: str, folder: Path, name: str) -> Path:
    """Write a table; raises ``OSError``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.csv"
    write_atomically(path, text.encode())
    return path


def open_outside(path: Path) -> str:
    """Open ``path`` in the viewer that the computer has for it; return what was done in words."""
    program = shutil.which(VIEWER)
    if program is None:
        return f"This computer has no {VIEWER}: the file is {path}"
    if not QProcess.startDetached(program, [str(path)])[0]:
        return f"{VIEWER} did not start: the file is {path}"
    return f"Opened outside: {path}"


def stamped(name: str) -> str:
    """Return a file name that begins with the date and cannot leave its folder."""
    safe = "".join(c if c.isalnum() or c in "-_" else "-" for c in name)
    return f"{datetime.now():%Y%m%d-%H%M%S}-{safe}"


def _mm(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
