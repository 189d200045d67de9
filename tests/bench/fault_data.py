"""Damaged episodes, hostile models, and pieces that are lost in mid-probe, by the hundreds."""

from __future__ import annotations

import random
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeFilter
from backend.core.facts import Fact, FaultRaised, PhaseEntered
from backend.core.faults import InputError, TouchdownError
from backend.dataset.episode_file import write_episode
from backend.dataset.episode_reading import read_episode
from backend.learning.checkpoint import load_checkpoint
from tests.backend.catalogue.test_salvage import an_episode, mutants, record_ends
from tests.backend.devices.trials import Ended
from tests.backend.learning.test_checkpoint import reseal, save_small
from tests.backend.runs.test_collect_faults import Failing
from tests.bench.registry import Figure, figure

MUTANTS, HANG_S = 2000, 10.0
BLOCK = 4096
HEADER_BYTES, REFUSED_S = 100_000_000, 1.0
LOST, SEEN_S = 200, 0.2
PHASES = ("approach", "press", "hold")


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


class _Losing(Failing):
    """As ``Failing``; the piece is lost some time after a phase of the first probe began."""

    def lose(self, phase: str, after_s: float) -> None:
        self.lost_s = float("inf")
        self._phase, self._after_s = phase, after_s
        step = self.session.advance

        def advance() -> None:
            step()
            if self.lost_s == float("inf") and self.session.clock_s() >= self._due_s:
                scene = self.session._scene
                assert scene is not None
                jaws = scene.stage.gripper._world.jaws
                jaws.piece_present = jaws.holding = False
                self.lost_s = self.session.clock_s()

        self.session.advance = advance

    def _take(self, fact: Fact) -> None:
        super()._take(fact)
        if isinstance(fact, PhaseEntered) and fact.phase == self._phase:
            self._due_s = min(self._due_s, fact.t_s + self._after_s)

    _phase, _after_s, _due_s = "", 0.0, float("inf")


def lost(seed: int) -> Ended:
    """Collect one probe, in which the piece is lost; return what does not hold."""
    rng = random.Random(seed)
    phase, after_s = rng.choice(PHASES), rng.uniform(0.0, 0.5)
    with (
        tempfile.TemporaryDirectory() as folder,
        Dataset.open(Path(folder) / "ds", person="ann") as dataset,
    ):
        losing = _Losing(dataset)
        losing.lose(phase, after_s)
        try:
            with suppress(TouchdownError):
                losing.run(count=1)
            kept = dataset.episodes(EpisodeFilter(deleted=None))
        finally:
            losing.session.close()
    phases = [f for f in losing.facts if isinstance(f, PhaseEntered)]
    # What is lost after the probe has ended was held while it lasted: that label is right.
    lifted_s = next((f.t_s for f in phases if f.phase == "lift"), float("inf"))
    told = [f for f in losing.facts if isinstance(f, FaultRaised) and f.fault.code == "PIECE-LOST"]
    rows = {
        "never lost": losing.lost_s < float("inf"),
        "a label": losing.lost_s >= lifted_s or not any(e.quality.accepted for e in kept),
        "not told": len(told) == 1,
        "told late": bool(told) and told[0].t_s - losing.lost_s <= SEEN_S,
    }
    broken = tuple(name for name, holds in rows.items() if not holds)
    return Ended(seed, "collecting", f"lost {after_s:.2f} s into {phase}", broken)


@figure("faults")
def pieces_lost_in_probes(count: int = LOST) -> list[Figure]:
    """The gripper loses its piece at a random instant of a probe: labels that come of it."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        ended = list(pool.map(lost, range(count), chunksize=5))
    broken = [one for one in ended if one.broken]
    name = f"probes of {count} with a lost piece that gave a label, or told late"
    return [Figure(name, len(broken), "", "0", not broken, str(broken[0]) if broken else "")]
