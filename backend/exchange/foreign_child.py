"""The process that opens foreign files: ``python -m backend.exchange.foreign_child KIND SRC DIR``.

Writes one file per episode into DIR and names each in a line of JSON on standard output.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from typing import cast

from backend.core.faults import InputError
from backend.exchange.foreign_episode import Read, save

READERS = {"lerobot": "lerobot_reading", "robomimic": "robomimic_reading"}
MEMORY_BYTES = 8_000_000_000


def main(kind: str, source: str, folder: str) -> None:
    """Read everything; whatever is wrong becomes one line."""
    _limit_memory()
    read = cast("Read", import_module(f"backend.exchange.{READERS[kind]}").read)
    try:
        for number, episode in enumerate(read(Path(source))):
            path = Path(folder) / f"{number:06d}.npz"
            save(episode, path)
            _tell({"episode": str(path)})
    except InputError as error:
        _tell({"error": error.what, "where": error.where, "fix": error.fix})
    except Exception as error:  # noqa: BLE001 - a foreign file may raise anything
        what = f"The file is damaged or foreign: {type(error).__name__}: {error}."
        _tell({"error": what, "where": source, "fix": "Use another copy, or export it again."})
    else:
        _tell({"done": True})


def _tell(answer: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def _limit_memory() -> None:
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


if __name__ == "__main__":
    main(*sys.argv[1:4])
