"""CSV: one row per episode, units in the names of the columns."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from backend.catalogue.dataset import Dataset
from backend.catalogue.geometry import Pair
from backend.catalogue.values import Label
from backend.core.faults import InputError
from backend.exchange.exporting import Job
from backend.exchange.label_rows import LabelRow
from backend.exchange.query import Chosen
from backend.exchange.signal_tables import SIGNALS, write_signals
from backend.objects import clipping
from backend.objects.shapes import turned

FILE = "episodes.csv"
COLUMNS = (
    "uuid", "recorded_utc", "grasped", "bottom", "x_mm", "y_mm", "theta_deg", "sigma_mm", "source",
    "state", "stable", "margin_mm", "quality", "file", "file_sha256", "rev_uuid", "grip_id",
    "mounting_id", "person", "split",
)  # fmt: skip
NEEDED = ("uuid", "x_mm", "y_mm")
MAX_BYTES = 1_000_000_000


def write(job: Job, folder: Path) -> Mapping[str, object]:
    """Write ``episodes.csv``: UTF-8, comma, point, a header line; and the tables of signals."""
    with (folder / FILE).open("w", newline="", encoding="utf-8") as file:
        rows = csv.DictWriter(file, COLUMNS)
        rows.writeheader()
        for one in job.chosen:
            pair = job.dataset.geometry.pair(one.revision.geometry)
            rows.writerow(_row(one, margin_mm(pair, one.revision.label)))
            if job.tables and one.entry.mode != "mass":
                write_signals(job.dataset, one.entry, folder / SIGNALS)
            job.advance(one.index + 1)
    return {"data": "csv"}


def margin_mm(pair: Pair, label: Label) -> float:
    """Return the signed distance of the centre of mass to the edge of the true overlap.

    Positive: it stands; minus infinity: no contact.
    """
    yaw_rad = math.radians((label.theta_mdeg or 0) / 1e3)
    x_mm, y_mm = label.offset_mm.tolist()
    cut = clipping.overlap(pair.face.placed((x_mm, y_mm), yaw_rad), pair.bottom.polygon())
    centre_mm = label.offset_mm + turned(np.array(pair.centre_mm), yaw_rad)
    return float(clipping.margins_mm(centre_mm, cut))


def _row(one: Chosen, margin: float) -> dict[str, object]:
    entry, revision, label = one.entry, one.revision, one.revision.label
    recorded = datetime.fromtimestamp(entry.recorded_ns / 1e9, UTC)
    return {
        "uuid": entry.uuid,
        "recorded_utc": recorded.isoformat(timespec="milliseconds"),
        "grasped": as_text(entry.piece),
        "bottom": as_text(entry.bottom),
        "x_mm": _thousandth(label.x_um),
        "y_mm": _thousandth(label.y_um),
        "theta_deg": _thousandth(label.theta_mdeg),
        "sigma_mm": _thousandth(label.sigma_um),
        "source": revision.source,
        "state": revision.state,
        "stable": "true" if margin >= 0.0 else "false",
        "margin_mm": f"{margin:.3f}" if math.isfinite(margin) else "",
        "quality": as_text("; ".join(entry.quality.reasons) or "accepted"),
        "file": entry.path,
        "file_sha256": entry.sha256,
        "rev_uuid": revision.rev_uuid,
        "grip_id": as_text(entry.grip_id),
        "mounting_id": as_text(entry.mounting_id),
        "person": as_text(entry.person),
        "split": as_text(one.split),
    }


def as_text(content: str) -> str:
    """Return what a spreadsheet shows as ``content`` and does not take for a formula."""
    return f"'{content}" if content.startswith(("=", "+", "-", "@", "\t", "\r")) else content


def _thousandth(value: int | None) -> str:
    return "" if value is None else f"{Decimal(value) / 1000:.3f}"


def read(source: Path, dataset: Dataset) -> Iterator[LabelRow]:
    """Yield the labels of ``episodes.csv``; raises ``InputError`` naming a bad line."""
    del dataset
    path = source / FILE if source.is_dir() else source
    if not path.is_file() or path.stat().st_size > MAX_BYTES:
        raise InputError("There is no table of at most 1 GB.", str(path), "Name the CSV file.")
    with path.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file)
        try:
            lacking = sorted(set(NEEDED) - set(rows.fieldnames or ()))
            if lacking:
                raise InputError(
                    f"The table lacks: {', '.join(lacking)}.", str(path), "Add these columns."
                )
            for row in rows:
                yield _label_row(row, path, rows.line_num)
        except (csv.Error, UnicodeDecodeError) as error:
            raise InputError(
                f"This is no table: {error}.", str(path), "Save it as CSV in UTF-8."
            ) from error


def _label_row(row: Mapping[str, str | None], path: Path, line: int) -> LabelRow:
    if None in row.values() or None in row:
        # A file that was cut short: what is left of a number looks like a number.
        raise _bad(path, line, "It has another number of fields than the first line.")
    names = ("x_mm", "y_mm", "theta_deg", "sigma_mm")
    values = [_whole(row.get(name), name, path, line) for name in names]
    if values[0] is None or values[1] is None:
        raise _bad(path, line, "It has no offset.")
    return LabelRow(row["uuid"] or "", row.get("file_sha256") or "", Label(*values))


def _whole(text: str | None, name: str, path: Path, line: int) -> int | None:
    """Return thousandths; a finer or absent number is not guessed at."""
    if not text:
        return None
    try:
        value = Decimal(text) * 1000
        whole = int(value)
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise _bad(path, line, f"{name} is no number: {text[:40]!r}.") from error
    if whole != value or abs(whole) > 10**9:
        raise _bad(path, line, f"{name} is finer than 0.001 or too large: {text[:40]!r}.")
    return whole


def _bad(path: Path, line: int, what: str) -> InputError:
    return InputError(what, f"{path}, line {line}", "Correct this line.")
