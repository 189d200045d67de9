"""CSV: one row per episode, units in the column names."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from touchdown.backend.annotations import Dataset, Label, Pair
from touchdown.backend.core import InputError, errors_as_input
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.label_import import ImportedLabel, label_file
from touchdown.backend.exchange.query import SelectedEpisode
from touchdown.backend.geometry import contact_edges, rotated, signed_distances_mm

FILE = "episodes.csv"
COLUMNS = (
    "uuid", "recorded_utc", "grasped", "bottom", "x_mm", "y_mm", "theta_deg", "sigma_mm", "source",
    "state", "stable", "margin_mm", "quality", "file", "file_sha256", "rev_uuid", "grip_id",
    "mounting_id", "person", "split",
)  # fmt: skip
NEEDED = ("uuid", "x_mm", "y_mm")


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write ``episodes.csv`` (UTF-8, comma, decimal point, header)."""
    with (folder / FILE).open("w", newline="", encoding="utf-8") as file:
        rows = csv.DictWriter(file, COLUMNS)
        rows.writeheader()
        for one in job.chosen:
            pair = job.dataset.geometry.pair(one.revision.geometry)
            rows.writerow(_row(one, margin_mm(pair, one.revision.label)))
            job.advance(one.index + 1)
    return {"data": "csv"}


def margin_mm(pair: Pair, label: Label) -> float:
    """Return the signed distance of the centre of mass to the hull of the true overlap.

    Positive: stable; minus infinity: no contact.
    """
    yaw_rad = math.radians((label.theta_mdeg or 0) / 1e3)
    x_mm, y_mm = label.offset_mm.tolist()
    cut = contact_edges(pair.face, (x_mm, y_mm), yaw_rad, pair.bottom)
    centre_mm = label.offset_mm + rotated(np.array(pair.centre_mm), yaw_rad)
    return float(signed_distances_mm(centre_mm, cut))


def _row(one: SelectedEpisode, margin: float) -> dict[str, object]:
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
    """Return a text that a spreadsheet shows as ``content`` and does not read as a formula."""
    return f"'{content}" if content.startswith(("=", "+", "-", "@", "\t", "\r")) else content


def _thousandth(value: int | None) -> str:
    return "" if value is None else f"{Decimal(value) / 1000:.3f}"


def read_csv(source: Path, dataset: Dataset) -> Iterator[ImportedLabel]:
    """Yield the labels of ``episodes.csv``; raises ``InputError`` with the bad line."""
    del dataset
    path = label_file(source, FILE)
    kinds, fix = (csv.Error, UnicodeDecodeError), "Save it as CSV in UTF-8."
    with (
        path.open(newline="", encoding="utf-8") as file,
        errors_as_input("This is no table", path, fix, *kinds),
    ):
        rows = csv.DictReader(file)
        lacking = sorted(set(NEEDED) - set(rows.fieldnames or ()))
        if lacking:
            fix = "Add these columns."
            raise InputError(f"The table lacks: {', '.join(lacking)}.", str(path), fix)
        for row in rows:
            yield _label_row(row, path, rows.line_num)


def _label_row(row: Mapping[str, str | None], path: Path, line: int) -> ImportedLabel:
    if None in row.values() or None in row:
        # In an incomplete file the rest of a number would look like a number.
        raise _bad(path, line, "It has another number of fields than the first line.")
    names = ("x_mm", "y_mm", "theta_deg", "sigma_mm")
    values = [_whole(row.get(name), name, path, line) for name in names]
    if values[0] is None or values[1] is None:
        raise _bad(path, line, "It has no offset.")
    return ImportedLabel(row["uuid"] or "", row.get("file_sha256") or "", Label(*values))


def _whole(text: str | None, name: str, path: Path, line: int) -> int | None:
    """Return a number in thousandths; raises ``InputError`` for a finer or missing number."""
    if not text:
        return None
    try:
        value = Decimal(text) * 1000
        whole = int(value)
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise _bad(path, line, f"{name} is no number: {text[:40]!r}.") from error
    most = 360_000 if name == "theta_deg" else 100_000
    if whole != value or not (0 if name == "sigma_mm" else -most) <= whole <= most:
        raise _bad(path, line, f"{name} is finer than 0.001, too large or negative: {text[:40]!r}.")
    return whole


def _bad(path: Path, line: int, what: str) -> InputError:
    return InputError(what, f"{path}, line {line}", "Correct this line.")
