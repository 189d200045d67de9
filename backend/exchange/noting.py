"""What an import leaves in the log: one operation for all of it, and one event."""

from __future__ import annotations

from backend.catalogue import heads, operations
from backend.catalogue.database import add_event
from backend.catalogue.dataset import Dataset


def note_import(
    dataset: Dataset,
    person: str,
    draft: operations.Draft,
    target: str,
    body: dict[str, str | int],
) -> None:
    """Commit ``draft`` as one operation of ``person``, together with the event about ``target``.

    A draft without revisions and marks is no operation: then the event alone is kept.
    """
    with dataset.labels.commit() as connection:
        if draft.revs or draft.marks:
            site = dataset.description.site
            _, touched = operations.append(connection, site, person, "import", draft)
            heads.refresh(connection, touched)
        add_event(connection, person, "import", target, body)
