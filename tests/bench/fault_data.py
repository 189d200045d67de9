"""Damaged episodes and hostile models, by the hundreds."""

from __future__ import annotations

import random
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from tests.backend.catalogue.test_salvage import an_episode, mutants, record_ends
from tests.backend.learning.test_checkpoint import reseal, save_small
from tests.bench.registry import Figure, figure
from touchdown.backend.core.faults import InputError
from touchdown.backend.episodes.episode_file import read_episode, write_episode
from touchdown.backend.learning.checkpoint import load_checkpoint

MUTANTS, HANG_S = 2000, 10.0
BLOCK = 4096
HEADER_BYTES, REFUSED_S = 100_000_000, 1.0


@figure("faults")
def damaged_episodes() -> list[Figure]:
    """Cut at each 4 KiB, flipped, zeroed, overwritten, lengths swapped: what is read of them."""
    refused = wrong = 0
    slowest_s = 0.0
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "e1.mcap"
        write_episode(path, an_episode(), {"episode": "e1", "x_um": 7}, {"mode": "stepped"})
        whole = path.read_bytes()
        truth = an_episode().observation
        for mutant in _damaged(whole):
            path.write_bytes(mutant)
            begun_s = time.process_time()
            try:
                wrong += not np.array_equal(read_episode(path).observation, truth)
            except InputError:
                refused += 1
            slowest_s = max(slowest_s, time.process_time() - begun_s)
    told = f"{refused} refused by an error of the known kind; slowest {1e3 * slowest_s:.0f} ms"
    name = f"damaged episodes of {MUTANTS} read as something else"
    return [Figure(name, wrong, "", "0, none over 10 s", wrong == 0 and slowest_s < HANG_S, told)]


def _damaged(whole: bytes) -> Iterator[bytes]:
    yield from (whole[:at] for at in range(0, len(whole), BLOCK))
    ends = list(record_ends(whole))
    rng, count = random.Random(5), -(-len(whole) // BLOCK)
    for one in ends[:-1]:
        # The length of one record in place of that of another.
        hurt, other = bytearray(whole), rng.choice(ends[:-1])
        hurt[one + 1 : one + 9] = whole[other + 1 : other + 9]
        if hurt != whole:
            count += 1
            yield bytes(hurt)
    yield from (m for m in mutants(whole, MUTANTS - count) if m != whole)


@figure("faults")
def hostile_models() -> list[Figure]:
    """Pickled code, a header of 100 MB, other tensors, no numbers: refused, and how soon."""
    slowest_s, taken, ran = 0.0, [], []
    for name, spoil in _SPOILT.items():
        with tempfile.TemporaryDirectory() as folder:
            path, witness = Path(folder) / "pot.safetensors", Path(folder) / "ran"
            spoil(path, witness, save_small(path))
            reseal(path)
            begun_s = time.process_time()
            try:
                load_checkpoint(path)
                taken.append(name)
            except InputError:
                slowest_s = max(slowest_s, time.process_time() - begun_s)
            ran += [name] if witness.exists() else []
    told = f"{len(_SPOILT)} kinds" + "".join(f"; {name} was taken" for name in [*taken, *ran])
    return [
        Figure("hostile models, slowest refusal", slowest_s, "s", "<= 1, nothing run",
               slowest_s <= REFUSED_S and not taken and not ran, told)
    ]  # fmt: skip


def _pickled(path: Path, witness: Path, _: object) -> None:
    code = f"open({str(witness)!r}, 'w')".encode()
    call = b"cbuiltins\nexec\n(X" + struct.pack("<I", len(code)) + code + b"tR."
    path.write_bytes(b"\x80\x02" + call)


def _long_header(path: Path, _: Path, __: object) -> None:
    path.write_bytes(struct.pack("<Q", HEADER_BYTES) + b"{" + b" " * (HEADER_BYTES - 2) + b"}")


def _with(**changes: np.ndarray) -> Callable[[Path, Path, dict[str, np.ndarray]], None]:
    return lambda path, _, arrays: save_file({**arrays, **changes}, path)


_SPOILT: dict[str, Callable[[Path, Path, dict[str, np.ndarray]], None]] = {
    "pickled code": _pickled,
    "100 MB header": _long_header,
    "extra tensor": _with(extra=np.zeros(1, np.float32)),
    "wrong shape": _with(**{"head.bias": np.zeros(6, np.float32)}),
    "no numbers": _with(**{"head.bias": np.full(5, np.nan, np.float32)}),
}
