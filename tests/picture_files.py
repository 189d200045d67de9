"""Files of ``make screens`` and ``make pictures``: each picture is written whole or not at all."""

import contextlib
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

from touchdown.backend.annotations.storage import check_free_space
from touchdown.backend.core.faults import InputError

PART = ".part"


class PictureFiles:
    """Pictures in a folder. An old picture stays until the new one is complete."""

    def __init__(self, folder: Path) -> None:
        """Create ``folder`` if needed; raises OSError if it cannot be written."""
        self._folder, self._kept = folder, list[Path]()
        folder.mkdir(parents=True, exist_ok=True)
        self.keep("trial.png", bytes(1 << 16))
        self.drop()

    def keep(self, name: str, content: bytes) -> None:
        """Write a picture to a temporary file; raises OSError if the disk refuses it."""
        beside = self._folder / f"{name}{PART}"
        self._kept.append(beside)
        try:
            beside.write_bytes(content)
        except OSError:
            self.drop()
            raise

    def put(self) -> None:
        for beside in self._kept:
            beside.replace(beside.with_suffix(""))
        self._kept.clear()

    def drop(self) -> None:
        for beside in self._kept:
            with contextlib.suppress(OSError):
                beside.unlink(missing_ok=True)
        self._kept.clear()


def run_reporting(draw: Callable[[], int]) -> int:
    """Run ``draw``; report an expected error in one line on standard output, a bug with its trace.

    Standard error is not shown: it carries messages of the Qt platform plugin.
    """
    try:
        check_free_space(Path(tempfile.gettempdir()))
        return draw()
    except InputError as error:
        why = f"{error.what} {error.where}: {error.fix}"
    except OSError as error:
        why = f"{error.filename or ''}: {error.strerror or error}."
    except Exception:  # noqa: BLE001 - a bug must be seen, and standard error is not shown
        traceback.print_exc(file=sys.stdout)
        return 1
    sys.stdout.write(f"The pictures are not finished; older ones are unchanged. {why}\n")
    return 1
