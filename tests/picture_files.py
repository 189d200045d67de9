"""Where ``make screens`` and ``make pictures`` put what they draw: whole, or not at all."""

from __future__ import annotations

import contextlib
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

from touchdown.backend.annotations.storage import free_space_for
from touchdown.backend.core.faults import InputError

PART = ".part"


class PictureFiles:
    """Pictures for a folder. A picture that was there stays until its successor is put whole."""

    def __init__(self, folder: Path) -> None:
        """``folder`` is made where it is missing; ``OSError`` where it cannot be written."""
        self._folder, self._kept = folder, list[Path]()
        folder.mkdir(parents=True, exist_ok=True)
        self.keep("trial", bytes(1 << 16))
        self.drop()

    def keep(self, name: str, png: bytes) -> None:
        """Write a picture beside its place; ``OSError`` where the disk refuses it."""
        beside = self._folder / f"{name}.png{PART}"
        self._kept.append(beside)
        try:
            beside.write_bytes(png)
        except OSError:
            self.drop()
            raise

    def put(self) -> None:
        """Put everything kept in its place."""
        for beside in self._kept:
            beside.replace(beside.with_suffix(""))
        self._kept.clear()

    def drop(self) -> None:
        """Take away what was kept and not put."""
        for beside in self._kept:
            with contextlib.suppress(OSError):
                beside.unlink(missing_ok=True)
        self._kept.clear()


def told(draw: Callable[[], int]) -> int:
    """Draw; what hinders it is told in one line on standard output, what is a bug with its trace.

    Standard error carries what Qt says of its platform, and is not read.
    """
    try:
        free_space_for(Path(tempfile.gettempdir()), 0)
        return draw()
    except InputError as error:
        why = f"{error.what} {error.where}: {error.fix}"
    except OSError as error:
        why = f"{error.filename or ''}: {error.strerror or error}."
    except Exception:  # noqa: BLE001 - a bug must be seen although nobody reads standard error
        traceback.print_exc(file=sys.stdout)
        return 1
    sys.stdout.write(f"The pictures are not finished, none from before is damaged. {why}\n")
    return 1
