"""Pieces that are lost, or turn in the grasp, at a random instant of a probe, by the hundreds."""

from __future__ import annotations

import math
import random
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path

from tests.backend.devices.trials import Ended
from tests.backend.runs.test_collect_faults import Failing
from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import EpisodeFilter
from touchdown.backend.core.events import Event, FaultRaised, PhaseEntered
from touchdown.backend.core.faults import TouchdownError
from touchdown.backend.simulation.world import World

COUNT, SEEN_S = 200, 0.2
PHASES = ("approach", "press", "hold")
TURNS_DEG, FELT_S, LAST_S = (1.5, 10.0), 0.3, 1.7
"""Angles of the turns; they come while the contact holds the piece, and in time to be seen."""


class _Struck(Failing):
    """As ``Failing``; something happens to the piece some time after a phase of the first probe
    began."""

    struck_s = _due_s = float("inf")

    def strike(self, phase: str, after_s: float, blow: Callable[[World], None]) -> None:
        self._phase, self._after_s = phase, after_s
        step = self.session.advance

        def advance() -> None:
            step()
            if self.struck_s == float("inf") and self.session.clock_s() >= self._due_s:
                scene = self.session._scene
                assert scene is not None
                blow(scene.stage.gripper._world)
                self.struck_s = self.session.clock_s()

        self.session.advance = advance

    def _take(self, fact: Event) -> None:
        super()._take(fact)
        if isinstance(fact, PhaseEntered) and fact.phase == self._phase:
            self._due_s = min(self._due_s, fact.t_s + self._after_s)

    _phase, _after_s = "", 0.0


def _lose(world: World) -> None:
    world.jaws.piece_present = world.jaws.holding = False


def lost(seed: int) -> Ended:
    """Collect one probe, in which the piece is lost; return what does not hold."""
    rng = random.Random(seed)
    phase, after_s = rng.choice(PHASES), rng.uniform(0.0, 0.5)
    return _collected(seed, phase, after_s, _lose, "PIECE-LOST", "lost")


def turned(seed: int) -> Ended:
    """Collect one probe, in which the piece turns; return what does not hold."""
    rng = random.Random(seed)
    after_s, angle_deg = rng.uniform(FELT_S, LAST_S), rng.choice((-1, 1)) * rng.uniform(*TURNS_DEG)

    def turn(world: World) -> None:
        assert world.holding is not None
        world.holding.turn(math.radians(angle_deg))

    told = f"turned by {angle_deg:.1f} degrees"
    return _collected(seed, "press", after_s, turn, "PIECE-TURNED", told)


def _collected(
    seed: int, phase: str, after_s: float, blow: Callable[[World], None], code: str, what: str
) -> Ended:
    with (
        tempfile.TemporaryDirectory() as folder,
        Dataset.open(Path(folder) / "ds", person="ann") as dataset,
    ):
        struck = _Struck(dataset)
        struck.strike(phase, after_s, blow)
        try:
            with suppress(TouchdownError):
                struck.run(count=1)
            kept = dataset.episodes(EpisodeFilter(deleted=None))
        finally:
            struck.session.close()
    phases = [f for f in struck.facts if isinstance(f, PhaseEntered)]
    # What is lost after the probe has ended was held while it lasted: that label is right.
    lifted_s = next((f.t_s for f in phases if f.phase == "lift"), float("inf"))
    told = [f for f in struck.facts if isinstance(f, FaultRaised) and f.fault.code == code]
    rows = {
        "never struck": struck.struck_s < float("inf"),
        "a label": struck.struck_s >= lifted_s or not any(e.quality.accepted for e in kept),
        "not told": len(told) == 1,
        "told late": bool(told) and told[0].t_s - struck.struck_s <= SEEN_S,
    }
    broken = tuple(name for name, holds in rows.items() if not holds)
    return Ended(seed, "collecting", f"{what} {after_s:.2f} s into {phase}", broken)


def _of(trial: Callable[[int], Ended], count: int) -> Sequence[Ended]:
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        return list(pool.map(trial, range(count), chunksize=5))


@figure("faults")
def pieces_lost_in_probes(count: int = COUNT) -> list[Figure]:
    """The gripper loses its piece at a random instant of a probe: labels that come of it."""
    broken = [one for one in _of(lost, count) if one.broken]
    name = f"probes of {count} with a lost piece that gave a label, or told late"
    return [Figure(name, len(broken), "", "0", not broken, str(broken[0]) if broken else "")]


@figure("faults")
def pieces_turned_in_probes(count: int = COUNT) -> list[Figure]:
    """The piece turns in the grasp at a random instant of a press: labels that come of it."""
    broken = [one for one in _of(turned, count) if one.broken]
    name = f"probes of {count} with a piece that turned and gave a label, or told late"
    return [Figure(name, len(broken), "", "0", not broken, str(broken[0]) if broken else "")]
