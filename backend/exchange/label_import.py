"""Import of labels for known episodes: new drafts in one operation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from touchdown.backend.annotations import (
    Dataset,
    Label,
    LabelContent,
    OperationDraft,
    add_event,
    append_operation,
    check_person,
    new_revision,
    read_review_status,
    refresh_heads,
    state_after,
)
from touchdown.backend.core import InputError, RefusedError


def note_import(
    dataset: Dataset, person: str, draft: OperationDraft, target: str, body: dict[str, str | int]
) -> None:
    """Commit ``draft`` as one operation of ``person``, with the event about ``target``.

    Without revisions and marks only the event is stored.
    """
    with dataset.labels.commit() as connection:
        if draft.revs or draft.marks:
            site = dataset.description.site
            _, touched = append_operation(connection, site, person, "import", draft)
            refresh_heads(connection, touched)
        add_event(connection, person, "import", target, body)


def label_file(source: Path, name: str) -> Path:
    """Return ``source``, or the file ``name`` in the export ``source``.

    Raises ``InputError`` if it does not exist or is too large.
    """
    path = source / name if source.is_dir() else source
    if not path.is_file() or path.stat().st_size > 1_000_000_000:
        raise InputError("There is no file of at most 1 GB.", str(path), "Name the file.")
    return path


@dataclass(frozen=True, slots=True)
class ImportedLabel:
    """One label of a file, for an ``episode`` or the hash of its file."""

    episode: str
    file_sha256: str
    label: Label
    warning: str = ""


@dataclass(frozen=True, slots=True)
class LabelImportResult:
    """Result of an import of labels: changed, equal and refused rows.

    ``backup``: the catalogue before the import, None if nothing was written.
    """

    changed: int
    unchanged: int
    refused: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    backup: Path | None = None


def import_labels(
    dataset: Dataset, rows: Iterable[ImportedLabel], person: str, where: str, *, check: bool = False
) -> LabelImportResult:
    """Set the labels of ``rows`` in the name of ``person``, as one operation.

    Equal labels are skipped. Rows that cannot be set (waiting for review, work of another person,
    unknown episode) are refused. ``check``: report only. Raises ``FaultError`` before anything is
    written if the catalogue cannot be backed up.
    """
    name = check_person(person)
    listed = list(rows)
    refused: list[tuple[str, str]] = []
    draft, unchanged, changed = OperationDraft(), 0, set[object]()
    for row in listed:
        try:
            change = _change(dataset, row, name)
        except RefusedError as error:
            refused.append((row.episode, error.detail))
            continue
        if change is None:
            unchanged += 1
        elif change["episode"] in changed:
            refused.append((row.episode, "An earlier row has the same episode."))
        else:
            changed.add(change["episode"])
            draft.revs.append(change)
    backup = None
    if draft.revs and not check:
        backup = dataset.back_up_for("import")
        body: dict[str, str | int] = {"labels": len(draft.revs), "refused": len(refused)}
        note_import(dataset, name, draft, where, body)
    warnings = tuple(f"{row.episode}: {row.warning}." for row in listed if row.warning)
    return LabelImportResult(len(draft.revs), unchanged, tuple(refused), warnings, backup)


def _change(dataset: Dataset, row: ImportedLabel, person: str) -> dict[str, object] | None:
    found = dataset.database.first(
        "SELECT uuid FROM episode WHERE uuid = ? OR (sha256 = ? AND NOT EXISTS"
        " (SELECT 1 FROM episode WHERE uuid = ?)) ORDER BY uuid",
        (row.episode, row.file_sha256, row.episode),
    )
    if found is None:
        raise RefusedError("unknown episode", "There is no such episode here.")
    head = dataset.labels.head(found[0])
    if row.label == head.label:
        return None
    with dataset.database.reading() as connection:
        state = state_after("set", read_review_status(connection, head.episode), person)
    content = replace(LabelContent.of(head), label=row.label, source="human")
    return new_revision(head.episode, head.rev_uuid, content, state)
