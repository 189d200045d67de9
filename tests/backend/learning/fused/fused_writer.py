"""Writes two networks in turn until it is killed, or until the disk takes no more; run by itself.

``FOLDER kill`` tells each write on its output; ``FOLDER full`` may write small files only.
"""

from __future__ import annotations

import resource
import signal
import sys
from itertools import cycle
from pathlib import Path

import numpy as np

from touchdown.backend.learning.checkpoint import save_checkpoint
from touchdown.backend.learning.fused.checkpoint import FusedCard
from touchdown.backend.learning.fused.features import FusedShape, expected_fused_arrays

SHAPE = FusedShape(width=16, heads=2, layers=1, inner=24, parts=2)
NAME = "fused.safetensors"


def write(folder: Path, number: int) -> None:
    """Write a network with all weights equal to ``number``."""
    arrays = {
        name: np.full(size, number, np.float32)
        for name, size in expected_fused_arrays(SHAPE).items()
    }
    facts = {"bench_sha256": "b", "data_sha256": "d", "seed": number, "program_version": "0"}
    save_checkpoint(folder / NAME, arrays, FusedCard(hyper=SHAPE, **facts))  # type: ignore[arg-type]


def main(folder: Path, what: str) -> None:
    """Run the mode given on the command line."""
    if what == "full":
        # Past this size the kernel refuses each write, as it does where no block is free.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        write(folder, 2)
    for number in cycle((1, 2)):
        write(folder, number)
        sys.stdout.write(f"{number}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
