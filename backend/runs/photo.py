"""A picture of a trial, taken by the operator, beside the journal of its run."""

from __future__ import annotations

from pathlib import Path

from backend.core.faults import InputError
from backend.core.files import write_atomically

FOLDER = "photos"
KINDS = (".jpg", ".jpeg", ".png")
MAX_BYTES = 30_000_000
_BEGINS = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")


def keep_photo(run: Path, trial: int, source: Path) -> Path:
    """Copy ``source`` into the folder of a run as the picture of ``trial``; return its new path.

    Each gets the number after the last: none takes the place of another. Raises ``InputError``
    naming the file.
    """
    fix = "Choose a JPEG or PNG picture below 30 MB."
    try:
        if source.stat().st_size > MAX_BYTES:
            raise InputError("The picture is too large.", str(source), fix)
        content = source.read_bytes()
        if source.suffix.lower() not in KINDS or not content.startswith(_BEGINS):
            raise InputError("This is no picture.", str(source), fix)
        name = f"trial-{trial:03d}-"
        taken = [p.stem.removeprefix(name) for p in (run / FOLDER).glob(f"{name}*")]
        number = max((int(word) for word in taken if word.isdecimal()), default=0) + 1
        path = run / FOLDER / f"{name}{number}{source.suffix.lower()}"
        write_atomically(path, content)
    except OSError as error:
        what = f"The picture cannot be kept: {error.strerror or error}."
        raise InputError(what, str(source), "Look at the file and at the disk.") from error
    return path
