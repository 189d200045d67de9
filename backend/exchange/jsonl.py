"""JSON lines: the operations of the labels as in the journals, with their hash chain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from touchdown.backend.annotations import (
    Dataset,
    Operation,
    add_event,
    canonical_json,
    check_person,
    merge_labels,
    read_operations,
)
from touchdown.backend.core import InputError, parse_json
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.label_import import label_file
from touchdown.backend.exchange.manifest import read_manifest

FILE = "labels.jsonl"
MAX_BYTES = 2_000_000_000
FIELDS = tuple(field.name for field in fields(Operation))


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write the whole log in its order, since a chain with gaps cannot be verified."""
    with job.dataset.database.reading() as connection:
        log = read_operations(connection)
    with (folder / FILE).open("wb") as file:
        for operation in log:
            file.write(canonical_json({name: getattr(operation, name) for name in FIELDS}) + b"\n")
    job.advance(len(job.chosen))
    return {"data": "json lines", "operations": len(log)}


def read_jsonl(source: Path) -> list[Operation]:
    """Return the operations of a file or export; raises ``InputError`` with the bad line."""
    path = label_file(source, FILE, MAX_BYTES)
    log = []
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            try:
                log.append(Operation(**parse_json(line)))
            except (ValueError, TypeError) as error:
                raise InputError(
                    f"This is no operation: {error}.", f"{path}, line {number}", "Export it again."
                ) from error
    return log


@dataclass(frozen=True, slots=True)
class LogImportResult:
    """Result of the import of a log. ``backup``: the catalogue before the import."""

    operations: int
    conflicts: tuple[str, ...]
    backup: Path | None


def import_log(dataset: Dataset, source: Path, person: str) -> LogImportResult:
    """Merge the operations of ``source`` into the dataset; both chains are verified.

    Raises ``InputError`` for a broken chain or labels of unknown episodes, and ``FaultError``
    before anything is written if the catalogue cannot be backed up.
    """
    name = check_person(person)
    manifest = read_manifest(source) if source.is_dir() else None
    if manifest is not None and manifest["dataset_uuid"] != dataset.description.uuid:
        raise _foreign(source)
    log = read_jsonl(source)
    try:
        named = {rev["episode"] for operation in log for rev in _revisions(operation)}
    except (KeyError, TypeError) as error:
        raise InputError(
            "An operation has no proper body.", str(source), "Export it again."
        ) from error
    known = {uuid for (uuid,) in dataset.database.rows("SELECT uuid FROM episode")}
    if not named <= known:
        raise _foreign(source)
    backup = dataset.back_up_for("import")
    with dataset.labels.commit() as connection:
        done = merge_labels(connection, log, str(source), episodes=0)
        body = {"operations": done.operations, "conflicts": len(done.conflicts)}
        add_event(connection, name, "import", source.name, body)
    dataset.labels.reload()
    return LogImportResult(done.operations, tuple(done.conflicts), backup)


def _revisions(operation: Operation) -> list[dict[str, str]]:
    revisions = operation.body["revs"]
    if not isinstance(revisions, list):
        raise TypeError("revs")
    return revisions


def _foreign(source: Path) -> InputError:
    return InputError(
        "These labels belong to episodes that are not in this dataset.",
        str(source),
        "Import them into a copy of the dataset that they were exported from.",
    )
