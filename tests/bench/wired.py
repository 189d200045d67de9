"""The emulated bench over real wires compared with the simulated one.

Real time over real sockets, terminals and pipes: on a busy computer presses are voided and
repeated, and a trial that a link fault ended is tried again. ``parts_of_the_first_probe`` uses a
stepped clock: noise of the sensor, law of the arm, and a world that falls behind.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tests.backend.emulators.wound import WoundWires, bursts, force_apart, simulated_press
from tests.bench.figures import Figure, at_least, at_most, figure
from touchdown.backend.bench import EmulatedBench, Session, SimulatedBenchChoice, simulated_session
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.events import (
    EpisodeRecorded,
    Event,
    FaultRaised,
    Paused,
    PhaseEntered,
    TrialFinished,
)
from touchdown.backend.core.faults import FaultError
from touchdown.backend.core.values import TACTILE_CHANNELS, Episode, FloatArray
from touchdown.backend.runs import RecordingOptions, StackRequest

FIRST_SEED, TRIALS = 300, 20
BOTTOMS = ("short", "long")
HELD = slice(15, 20)
TRIAL_ATTEMPTS = 3


@dataclass
class Run:
    """Result of one trial: end, first episode, faults."""

    ends: list[TrialFinished] = field(default_factory=list)
    episodes: list[Episode] = field(default_factory=list)
    # includes sensors that paused the run; without an operator this ends the try
    faults: list[str] = field(default_factory=list)
    presses: int = 0  # presses before the first episode; repeated presses move the piece

    def hear(self, fact: Event) -> None:
        if isinstance(fact, TrialFinished):
            self.ends.append(fact)
        elif isinstance(fact, EpisodeRecorded):
            self.episodes.append(fact.episode)
        elif isinstance(fact, PhaseEntered):
            self.presses += fact.phase == "press" and not self.episodes
        elif isinstance(fact, FaultRaised | Paused):
            self.faults.append(fact.fault.code)


def stack(session: Session, seed: int) -> Run:
    run = Run()
    leave = session.events.subscribe(run.hear)
    try:
        session.run(StackRequest("pot", (BOTTOMS[seed % 2],), seed))
    finally:
        leave()
    return run


def tried(session: Session, seed: int) -> Run:
    """Return what a trial gave; one whose devices could not be connected gave its fault alone."""
    try:
        return stack(session, seed)
    except FaultError as error:
        return Run(faults=[error.fault.code])


def held(episode: Episode) -> tuple[FloatArray, FloatArray]:
    """Return mean wrench (6,) and marker displacements (252,) px of the ticks of the hold."""
    ticks = episode.observation[HELD].astype(np.float64).mean(axis=0)
    return ticks[TACTILE_CHANNELS:], ticks[:TACTILE_CHANNELS]


def compare(trials: int = TRIALS) -> list[Figure]:
    alike, wrench_off, marker_off, presses = 0, [], [], []
    ended: Counter[str] = Counter()
    simulated = simulated_session(SimulatedBenchChoice(), keep=RecordingOptions(None))
    with EmulatedBench(SimulatedBenchChoice(), keep=RecordingOptions(None)) as bench:
        for seed in range(FIRST_SEED, FIRST_SEED + trials):
            wanted = stack(simulated, seed)
            for _ in range(TRIAL_ATTEMPTS):
                found = tried(bench.session, seed)
                if not found.faults:
                    break
                ended[found.faults[0]] += 1
                bench.session.reset()
            alike += bool(found.ends) and wanted.ends[-1].outcome is found.ends[-1].outcome
            if found.episodes and wanted.episodes:
                (wrench, px), (other, other_px) = held(wanted.episodes[0]), held(found.episodes[0])
                off = np.linalg.norm(other[:3] - wrench[:3]) / np.linalg.norm(wrench[:3])
                wrench_off.append(100.0 * float(off))
                marker_off.append(float(np.sqrt(np.mean((other_px - px) ** 2))))
                presses.append(found.presses - wanted.presses)
    simulated.close()
    note = f"{ended.total()} tries ended by a link fault and repeated"
    note += "".join(f"; {count} {code}" for code, count in ended.most_common())
    if not wrench_off:
        return [
            Figure("emulated: outcomes as simulated", 0, f"of {trials}", "", ok=False, note=note)
        ]
    wrench_pc, marker_px = float(np.median(wrench_off)), float(np.median(marker_off))
    within = sum(off <= 2.0 for off in wrench_off)
    spread = f"median; {within} of {len(wrench_off)} within 2 %, largest {max(wrench_off):.1f} %"
    repeated = [off for off, more in zip(wrench_off, presses, strict=True) if more]
    spread += f"; {sum(off <= 2.0 for off in repeated)} of {len(repeated)} after a void press"
    least, largest = round(0.9 * trials), f"median; largest {max(marker_off):.2f} px"
    return [
        at_least("emulated: outcomes as simulated", alike, f"of {trials}", least, note),
        at_most("emulated: force of the first probe", wrench_pc, "% off", 2, spread),
        at_most("emulated: markers of the first probe", marker_px, "px rms off", 0.2, largest),
    ]


@figure("wired")
def emulated_beside_simulated() -> list[Figure]:
    return compare()


MOST_PC = 2.0
BEHIND_S = 0.06
NOISY = SimulationSettings()
STILL = SimulationSettings.model_validate({"wrist": {"white_n": 0.01, "white_nm": 0.0004}})
LONGER_S = 1.7  # a longer rest before the press gives other noise and changes nothing else


def share(name: str, apart_pc: Sequence[float], *, promised: bool = True) -> Figure:
    """Return the median of one comparison, with how many are within the limit."""
    median_pc, within = float(np.median(apart_pc)), sum(pc <= MOST_PC for pc in apart_pc)
    note = f"median; {within} of {len(apart_pc)} within 2 %, largest {max(apart_pc):.1f} %"
    target, ok = ("<= 2", median_pc <= MOST_PC) if promised else ("stated", None)
    return Figure(f"first probe: {name}", median_pc, "% off", target, ok, note)


@figure("wired")
def parts_of_the_first_probe(trials: int = TRIALS) -> list[Figure]:
    noise, wires, behind, law = [], [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + trials):
        wanted = simulated_press(seed, NOISY)
        noise.append(force_apart(wanted, simulated_press(seed, NOISY, LONGER_S)))
        wires.append(force_apart(wanted, WoundWires(seed, NOISY, bursts(0.0)).press()))
        behind.append(force_apart(wanted, WoundWires(seed, NOISY, bursts(BEHIND_S)).press()))
        still = simulated_press(seed, STILL)
        law.append(force_apart(still, WoundWires(seed, STILL, bursts(0.0)).press()))
    return [
        share("simulated twice, other sensor noise", noise, promised=False),
        share("wires, stepped clock", wires),
        share("the same, world up to 60 ms behind", behind),
        share("wires, nearly no sensor noise: the arm's law", law),
    ]
