"""Fault campaign: a fault strikes an activity at a random instant, judged by ``docs/endings.toml``.

``python -m tests.bench.campaign`` (``make campaign``) runs the strikes that are missing in
``docs/results/campaign.json``, which belongs to one state of the sources, and renders the tables in
``docs/faults.md``. Activities on the simulated bench run by stepped clock; those on the emulated
bench in real time over real wires. Strikes of ``make:`` feed one driver by stepped clock.
"""

import argparse
import datetime
import hashlib
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from functools import cache, partial
from math import inf
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil

from tests.backend.bench.brisk import brisk_bench, brisk_method
from tests.backend.devices.melfa.trials import trial as arm_trial
from tests.backend.devices.optoforce.trials_wrist import EMULATED as WRIST_SENSORS
from tests.backend.devices.optoforce.trials_wrist import trial as wrist_trial
from tests.backend.devices.trials_camera import trial as camera_trial
from tests.backend.devices.wsg.trials_gripper import trial as gripper_trial
from tests.bench.figures import DOCS, Figure, failures, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench import EmulatedBench, Session, SimulatedBenchChoice, simulated_session
from touchdown.backend.bench.emulated_scene import command_travel
from touchdown.backend.core.events import (
    EpisodeRecorded,
    Event,
    FaultRaised,
    Paused,
    ProbeCollected,
)
from touchdown.backend.core.faults import Fault, FaultError, RefusedError, TouchdownError
from touchdown.backend.core.files import write_atomically
from touchdown.backend.devices.jog import JogOrder
from touchdown.backend.emulation import DisturbanceScript
from touchdown.backend.emulation.fault_plan import DEVICE_KINDS, WIRE_KINDS
from touchdown.backend.emulation.simulated_disturbances import DISTURBANCE_KINDS, Disturbance
from touchdown.backend.episodes.episode_mcap import read_episode
from touchdown.backend.runs.engine import _fault_of
from touchdown.backend.runs.event_log import read_events
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import (
    CalibrateRequest,
    CollectRequest,
    SceneChoice,
    StackRequest,
)

ENDINGS, PAGE = DOCS / "endings.toml", DOCS / "faults.md"
RESULTS = DOCS / "results" / "campaign.json"
ROOT = DOCS.parent
SAMPLE, TRIALS = 60, 20  # strikes of the sample; trials of a strike on a stepped wire
# strikes of each kind, by bench
TURNS = {"simulated": 10, "emulated": 4, "stepped wire": 5}
ACTIVITIES = ("stacking", "collecting", "calibrating", "jogging")
CAMERAS = ("tactile_left", "tactile_right")
# latest instant of a strike after the start of the motion, by bench, s
LATEST_S = {"simulated": 8.0, "emulated": 5.0}
# duration of a fault; time after it in which it may still be reported; time the arm may brake
LASTS_S, WATCH_S, BRAKE_S = 2.5, 1.5, 0.3
JOG_MM_S, JOG_S, INSIST_S, SETTLE_S = 5.0, 10.0, 0.5, 1.0
# largest travel of the commands after the report, mm; upwards by what the table allows
SIDE_MM, DOWN_MM, UP_MM = 0.5, 0.1, {"stand": 0.5, "retreat": 2.5, "lift": inf}
INTERNAL = re.compile(r"[a-z]+_[a-z_]+|\bbyte \d|Error\b|Traceback|touchdown\.|\bNone\b")
CHECKS = ("documented", "in time", "jaws", "arm", "data", "message")
Row = dict[str, Any]


@dataclass(frozen=True)
class Ending:
    """Row of the table of allowed endings."""

    row: str
    strikes: tuple[str, ...]
    codes: tuple[str, ...] = ()
    within_s: float = inf
    then: str = "lift"
    must: bool = False
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Seen:
    """Observations of a strike: code of the reported fault ("" if none), time from the strike to
    the report, message, openings of the jaws and travel of the commands after the report, lost
    records; whether the activity came to an end, and whether the fault struck it at all.
    """

    code: str = ""
    after_s: float | None = None
    message: tuple[str, str, str] = ("", "", "")
    openings: int = 0
    travel_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lost: tuple[str, ...] = ()
    ended: bool = True
    struck: bool = True


@cache
def endings() -> tuple[Mapping[str, Ending], frozenset[str]]:
    """Return the allowed ending of each strike, and the faults of a busy computer."""
    content = tomllib.loads(ENDINGS.read_text("utf-8"))
    found: dict[str, Ending] = {}
    for row in content["ending"]:
        made = Ending(**{k: tuple(v) if isinstance(v, list) else v for k, v in row.items()})
        for strike in made.strikes:
            device, kind = strike.split(":")
            for name in CAMERAS if device == "camera" else (device,):
                found[f"{name}:{kind}"] = made
    return found, frozenset(content["load"])


def judge(rule: Ending, seen: Seen, load: Iterable[str] = ()) -> dict[str, bool]:
    """Return by name of ``CHECKS`` whether it holds."""
    reported = bool(seen.code)
    by_load = seen.code in load and seen.code not in rule.codes
    side_mm, down_mm, up_mm = seen.travel_mm
    text = re.sub(r"\S*/\S*/\S*", "", " ".join(seen.message))  # without paths
    named = not rule.names or any(word in text.lower() for word in rule.names)
    clear = all(map(str.strip, seen.message)) and not INTERNAL.search(text)
    return {
        "documented": seen.ended
        and seen.struck
        and (seen.code in rule.codes or by_load if reported else not rule.must),
        "in time": by_load or seen.after_s is None or seen.after_s <= rule.within_s,
        "jaws": seen.openings == 0,
        "arm": side_mm <= SIDE_MM and down_mm <= DOWN_MM and up_mm <= UP_MM[rule.then],
        "data": not seen.lost,
        "message": not reported or seen.code == "ended" or (clear and (named or by_load)),
    }


class Watch:
    """Session under one strike: strikes at its instant, notes the report, ends what goes on."""

    def __init__(self, session: Session, blow: Callable[[], object], at_s: float) -> None:
        self.session, self._blow, self._at_s = session, blow, at_s
        self.facts: list[Event] = []
        self.acting = True  # a strike after an activity proves nothing
        self.fault: Fault | None = None
        self.before: Fault | None = None
        self.struck_s = self.reported_s = self.wall_s = inf
        self.openings = 0
        self._scene: object = None
        self._begun_s = inf
        self._step = session.advance
        session.advance = self._advance  # type: ignore[method-assign]
        self._leave = session.events.subscribe(self._hear)

    def close(self) -> None:
        """Give the session back."""
        self._leave()
        self.session.advance = self._step  # type: ignore[method-assign]

    def report(self, fault: Fault) -> None:
        """Note the first fault after the strike, and the last before it."""
        if self.struck_s == inf:
            self.before = fault
        elif self.fault is None:
            self.fault = fault
            self.reported_s, self.wall_s = self.session.clock_s(), time.monotonic()

    def _hear(self, fact: Event) -> None:
        self.facts.append(fact)
        if isinstance(fact, FaultRaised | Paused):
            self.report(fact.fault)

    def _advance(self) -> None:
        self._step()
        session = self.session
        now_s = session.clock_s()
        for fault in session.interlock.faults[:1]:
            self.report(fault)
        if session._scene is not self._scene:
            self._scene = session._scene
            self._begun_s = now_s
            self._watch_jaws()
        if self.struck_s == inf:
            if self.acting and now_s >= self._begun_s + self._at_s:
                self.struck_s, at_s = now_s, self._blow()
                if isinstance(at_s, float):  # the process of the devices was late
                    self.struck_s = session.clock_s() - (time.monotonic() - at_s)
        elif self.fault is None and now_s > self.struck_s + LASTS_S + WATCH_S:
            self.acting = False
            session.stop()

    def _watch_jaws(self) -> None:
        gripper: Any = self.session._stage.gripper
        real = gripper.open_to

        def open_to(width_mm: float, speed_mm_s: float) -> Any:
            self.openings += self.fault is not None and gripper.status().holding
            return real(width_mm, speed_mm_s)

        gripper.open_to = open_to


def act(watch: Watch, activity: str, seed: int) -> None:
    """Carry out one activity to its end."""
    session, rng = watch.session, random.Random(seed)
    if activity == "stacking":
        session.run(StackRequest("pot", ("short",), seed))
    elif activity == "collecting":
        session.run(CollectRequest(count=2, seed=seed, person="campaign", grips_per_mounting=10))
    elif activity == "calibrating":
        session.run(CalibrateRequest(rng.choice(("payload", "board")), seed=seed))
    else:
        session.prepare(SceneChoice("pot", ("circle15",), seed))
        assert session.hand is not None
        begun_s, press, sequence = session.clock_s(), 1, 0
        # The operator holds the button on for a while after the report, and presses it again.
        while watch.acting and session.clock_s() < min(
            begun_s + JOG_S, watch.reported_s + INSIST_S
        ):
            now_s, sequence = session.clock_s(), sequence + 1
            try:
                if now_s > begun_s + SETTLE_S:  # there are samples to judge a jog by
                    session.hand.jog.renew(JogOrder(press, sequence, now_s, "z", "XYZ", JOG_MM_S))
            except RefusedError:
                press += 1
            session.advance()
        session.hand.jog.end(press)


def observe(watch: Watch, activity: str, seed: int) -> None:
    """Act; note a fault that only an exception reports, and let the arm come to rest."""
    session = watch.session
    try:
        act(watch, activity, seed)
    except FaultError as error:
        watch.report(error.fault)
    except (TouchdownError, OSError) as error:
        watch.report(_fault_of(error))
    watch.acting = False
    end_s = session.clock_s() + SETTLE_S
    while session._scene is not None and session.clock_s() < end_s:
        with suppress(TouchdownError):
            session.advance()


def lost_records(facts: Iterable[Event], dataset: Dataset, runs: Path | None) -> tuple[str, ...]:
    """Return the acknowledged records that are missing or cannot be read."""
    lost = []
    for fact in facts:
        try:
            if isinstance(fact, ProbeCollected):
                dataset.read(fact.uuid)
            elif isinstance(fact, EpisodeRecorded) and "/" in fact.path:  # in the dataset
                read_episode(dataset.folder / fact.path)
            elif isinstance(fact, EpisodeRecorded) and fact.path and runs is not None:
                read_episode(runs / "episodes" / fact.path)
        except (TouchdownError, OSError, KeyError, ValueError) as error:
            lost.append(f"{type(error).__name__}: {error}")
    return tuple(lost)


# -- strikes --------------------------------------------------------------------------------------


def clock_and_disk(kind: str, ends: ExitStack) -> Callable[[], object] | None:
    """Return the blow of what both benches have: the wall clock jumps, or the disk refuses."""
    if kind == "clock:jump":
        real = time.time
        return lambda: ends.enter_context(patch("time.time", lambda: real() + 3600.0))
    if kind != "disk:full":
        return None

    def fill() -> None:
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
        ends.callback(resource.setrlimit, resource.RLIMIT_FSIZE, limits)

    return fill


def simulated_blow(session: Session, kind: str) -> None:
    """Start a disturbance on the simulated bench."""
    device, what = kind.split(":")
    bench: Any = session._stage.advance.__self__  # type: ignore[attr-defined]
    if what == "part_lost":
        bench._world.jaws.lose()
        return
    much = {"slow": 300.0 if device == "force_torque" else 8.0, "drift": 1.0, "turn": 4.0}
    begun = Disturbance(device, what, session.clock_s(), LASTS_S, much.get(what))
    for part in (bench, bench._world, *bench.tactile.values()):
        part._script = DisturbanceScript((begun,))


def emulated_blow(bench: EmulatedBench, kind: str) -> float | None:
    """Start a fault of an emulated device, or send a signal to a process.

    Return the monotonic time at which the process of the devices started the fault.
    """
    device, what = kind.split(":")
    assert bench._truth is not None
    if device == "rig":
        assert bench._wired is not None
        os.kill(bench._wired.link.hello["pid"], signal.Signals[what])
    elif device == "devices":
        assert bench._process._child is not None
        bench._process._child.send_signal(signal.Signals[what])
    else:
        amount = {"slow": {"hz": 300.0 if device == "force_torque" else 8.0}}
        more = amount | {"drift": {"n_per_s": 1.0}, "late": {"share": 0.2, "by_s": 0.05}}
        more |= {wire: {"share": 0.2} for wire in ("lost", "flip", "garbage", "cut", "duplicate")}
        return bench._truth.strike(device, what, LASTS_S, **more.get(what, {}))
    return None


def strike_session(bench: str, kind: str, activity: str, seed: int, latest_s: float) -> Seen:
    """Strike an activity on a bench of this process, ``latest_s`` after its start at the latest."""
    at_s = random.Random(seed).uniform(0.2, latest_s)
    with ExitStack() as ends, tempfile.TemporaryDirectory() as name:
        runs, folder = Path(name) / "runs", Path(name) / "ds"
        dataset = ends.enter_context(Dataset.open(folder, person="campaign"))
        common = clock_and_disk(kind, disk := ends.enter_context(ExitStack()))
        keep = RecordingOptions(runs)
        if bench == "simulated":
            session = simulated_session(brisk_bench("quiet"), keep=keep, method=brisk_method())
            ends.callback(session.close)
            blow = partial(simulated_blow, session, kind)
        else:
            wired = EmulatedBench(SimulatedBenchChoice(), keep=keep, method=brisk_method())
            ends.callback(wired.close)
            session, blow = wired.session, partial(emulated_blow, wired, kind)
        watch = Watch(session, common or blow, at_s)
        session.dataset = dataset
        observe(watch, activity, seed)
        travel = (0.0, 0.0, 0.0)
        if watch.fault is not None and bench == "simulated":
            sent = session.raw.commands.window(watch.reported_s + BRAKE_S, inf)
            travel = command_travel(list(zip(sent.t_s, sent.values, strict=True)), -inf)
        elif watch.fault is not None:
            with suppress(FaultError):  # the devices are gone
                travel = wired._truth.command_travel(watch.wall_s + BRAKE_S)  # type: ignore[union-attr]
        disk.close()
        lost = lost_records(watch.facts, dataset, session.run_folder)
        watch.close()
        ended, fault = not session.engine.busy, watch.fault
        if fault is None:
            struck, before = watch.struck_s < inf, watch.before
            told = ("", "", "" if struck or before is None else f"{before.code} before the strike")
            return Seen("", None, told, watch.openings, travel, lost, ended, struck)
        after_s = watch.reported_s - watch.struck_s
        message = stored_message(fault, name)
        return Seen(fault.code, after_s, message, watch.openings, travel, lost, ended)


def stored_message(fault: Fault, folder: str) -> tuple[str, str, str]:
    """Return the message of ``fault``, with DATA for ``folder``, which every strike has anew."""
    what, consequence, next_step = (
        part.replace(folder, "DATA") for part in (fault.what, fault.consequence, fault.next_step)
    )
    return what, consequence, next_step


VERBS = {
    "stacking": ("stack", "--preset", "quiet"),
    "collecting": ("collect", "--preset", "quiet", "--count", "40", "--person", "campaign"),
}


def strike_program(bench: str, kind: str, activity: str, seed: int) -> Seen:
    """Send a signal to the program; it ends, leaves no process and loses nothing it has logged."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = [*VERBS[activity], "--runs", str(folder / "runs"), "--seed", str(seed)]
        words += ["--emulated"] * (bench == "emulated")
        words += ["--dataset", str(folder / "ds")] * (activity == "collecting")
        # A campaign started in the background of a script ignores Ctrl-C; a child would inherit it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        child = subprocess.Popen(
            [sys.executable, "-m", "touchdown", *words],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env={**os.environ, "XDG_DATA_HOME": name},
        )  # fmt: skip
        with suppress(subprocess.TimeoutExpired):
            child.wait(rng.uniform(4.0, 12.0))
        started = psutil.Process(child.pid).children(recursive=True) if child.poll() is None else []
        begun_s = time.monotonic()
        child.send_signal(signal.Signals[kind.split(":")[1]])
        try:
            child.wait(10.0)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        _, left = psutil.wait_procs(started, timeout=8.0)
        after_s = time.monotonic() - begun_s
        logs = [log.parent for log in (folder / "runs").rglob("journal.jsonl")]
        with Dataset.open(folder / "ds", person="campaign") as dataset:
            lost = [one for log in logs for one in lost_records(read_events(log), dataset, log)]
        for process in left:
            process.kill()
        return Seen("ended", after_s, lost=tuple(lost), ended=not left)


def strike_driver(kind: str, seed: int) -> Seen:
    """Feed the driver of one make with random faults of its stepped wire."""
    make = kind.split(":")[1]
    trials = {"arm": arm_trial, "gripper": gripper_trial, "camera": camera_trial}
    for one in range(TRIALS * seed, TRIALS * (seed + 1)):
        ended: Any = trials[make](one) if make in trials else wrist_trial(one, make)
        message = ("", "", str(ended))
        if ended.broken:
            break
    return Seen("ended", 0.0, message, ended=not ended.broken)


def all_kinds() -> list[tuple[str, str]]:
    """Return every bench with every strike of it."""
    common = [f"program:{name}" for name in ("SIGKILL", "SIGTERM", "SIGINT")]
    common += ["disk:full", "clock:jump"]
    simulated = [
        f"{device}:{kind}" for device, kinds in DISTURBANCE_KINDS.items() for kind in kinds
    ]
    emulated = [f"{d}:{kind}" for d, own in DEVICE_KINDS.items() for kind in (*WIRE_KINDS, *own)]
    emulated += ["arm:reorder", "rig:SIGKILL", "rig:SIGTERM", "rig:SIGSTOP"]
    emulated += ["devices:SIGKILL", "devices:SIGSTOP"]
    makes = [f"make:{name}" for name in (*WRIST_SENSORS, "arm", "gripper", "camera")]
    return [
        *(("simulated", kind) for kind in (*simulated, "gripper:part_lost", *common)),
        *(("emulated", kind) for kind in (*emulated, *common)),
        *(("stepped wire", kind) for kind in makes),
    ]


def plan() -> list[tuple[int, str, str, str]]:
    """Return the strikes: number, bench, kind and activity; all kinds before any comes again."""
    order, strikes = random.Random(1), []
    for turn in range(max(TURNS.values())):
        kinds = list(enumerate(all_kinds()))
        order.shuffle(kinds)
        for k, (bench, kind) in kinds:
            possible = ACTIVITIES
            if kind.startswith("program:"):
                possible = tuple(VERBS) if bench == "simulated" else ("stacking",)
            elif bench == "stepped wire":
                possible = ("streaming",)
            if turn < TURNS[bench]:
                activity = possible[(turn + k) % len(possible)]
                strikes.append((len(strikes), bench, kind, activity))
    return strikes


def _run_planned(strike: tuple[int, str, str, str]) -> Row:
    return run_strike(*strike)


def run_strike(number: int, bench: str, kind: str, activity: str) -> Row:
    """Run one strike and judge it."""
    rules, load = endings()
    seed, begun_s = 50_000 + number, time.monotonic()
    try:
        if kind.startswith("program:"):
            seen = strike_program(bench, kind, activity, seed)
        elif bench == "stepped wire":
            seen = strike_driver(kind, seed)
        else:
            for latest_s in (LATEST_S[bench], 2.0, 0.5):  # an activity may end before
                seen = strike_session(bench, kind, activity, seed, latest_s)
                if seen.struck:
                    break
    except Exception as error:  # noqa: BLE001 - one strike does not end the campaign
        seen = Seen("crashed", 0.0, (repr(error), "", traceback.format_exc()[-600:]), ended=False)
    broken = [name for name, holds in judge(rules[kind], seen, load).items() if not holds]
    return {
        "number": number, "bench": bench, "strike": kind, "activity": activity,
        **asdict(seen), "broken": broken, "took_s": round(time.monotonic() - begun_s, 1),
    }  # fmt: skip


# -- campaign -------------------------------------------------------------------------------------


def source_hash() -> str:
    """Return the hash of the product, of this module and of the table of endings."""
    found = hashlib.sha256()
    for path in sorted((*(ROOT / "backend").rglob("*.py"), Path(__file__), ENDINGS)):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def stored(source: str = "") -> Mapping[str, Any] | None:
    """Return the stored campaign of this state of the sources ("": of any), None without one."""
    content = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else None
    return content if content and source in ("", content["source"]) else None


def save(rows: Sequence[Row], source: str) -> None:
    """Store the rows and render the page."""
    date = datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="seconds")
    ordered = sorted(rows, key=lambda row: row["number"])
    content = {"date": date, "source": source, "strikes": ordered}
    write_atomically(RESULTS, (json.dumps(content, indent=0) + "\n").encode())
    write_atomically(PAGE, rendered(PAGE.read_text("utf-8"), content).encode())


def run(strikes: Sequence[tuple[int, str, str, str]], workers: int,
        keep: Callable[[list[Row]], None], rows: list[Row]) -> list[Row]:  # fmt: skip
    """Run what is missing in ``rows``; ``keep`` is called after each strike."""
    known = {row["number"] for row in rows}
    waiting = [one for one in strikes if one[0] not in known]
    # A fresh process for every 20 strikes. An executor with `max_tasks_per_child` can hang when
    # all its processes are used up: https://github.com/python/cpython/issues/115634.
    with get_context("spawn").Pool(workers, maxtasksperchild=20) as pool:
        for row in pool.imap_unordered(_run_planned, waiting):
            rows.append(row)
            keep(rows)
    return rows


def endings_table() -> str:
    """Return the table of allowed endings as Markdown."""
    rows = dict.fromkeys(endings()[0].values())
    then = {"stand": "stands", "retreat": "stands, or rises by 2 mm", "lift": "may be lifted"}
    lines = ["| row | strikes | reported as | within | then the arm | ends the activity |"]
    lines.append("|---|---|---|---|---|---|")
    for one in rows:
        within = "" if one.within_s == inf else f"{one.within_s:g} s"
        must = "yes" if one.must else "not always"
        cells = (one.row, ", ".join(one.strikes), ", ".join(one.codes) or "nothing", within)
        lines.append(f"| {' | '.join((*cells, then[one.then], must))} |")
    return "\n".join(lines)


def results_table(content: Mapping[str, Any] | None) -> str:
    """Return the results by bench and device as Markdown."""
    if content is None:
        return "No campaign was run yet."
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in content["strikes"]:
        groups[row["bench"], row["strike"].split(":")[0]].append(row)
    lines = [f"{len(content['strikes'])} strikes, {content['date']}, source {content['source']}."]
    lines += ["", f"| bench | device | strikes | {' | '.join(CHECKS)} | latest report |"]
    lines.append("|" + "---|" * (len(CHECKS) + 4))
    for (bench, device), rows in groups.items():
        broken = Counter(name for row in rows for name in row["broken"])
        latest = max((row["after_s"] or 0.0 for row in rows), default=0.0)
        counts = " | ".join(str(len(rows) - broken[name]) for name in CHECKS)
        lines.append(f"| {bench} | {device} | {len(rows)} | {counts} | {latest:.2f} s |")
    return "\n".join(lines)


def rendered(text: str, content: Mapping[str, Any] | None) -> str:
    """Return the page with both generated tables."""
    for name, table in (("endings", endings_table()), ("campaign", results_table(content))):
        block = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end {name} -->)", re.DOTALL)
        text, count = block.subn(lambda m, t=table: m[1] + t + m[2], text)  # type: ignore[misc]
        assert count == 1, name
    return text


def summary(rows: Sequence[Row]) -> list[Figure]:
    """Return one figure per check."""
    found = []
    for name in CHECKS:
        broken = [row for row in rows if name in row["broken"]]
        note = ", ".join(f"{row['number']}: {row['bench']} {row['strike']}" for row in broken[:3])
        told = f"fault campaign, not held: {name}"
        found.append(failures(told, len(broken), f"of {len(rows)}", note))
    return found


@figure("faults", long=True)
def sample_of_the_fault_campaign() -> list[Figure]:
    """Strikes of every bench and device, spread over the campaign."""
    strikes = plan()
    return summary(run(strikes[:: len(strikes) // SAMPLE], 2, lambda rows: None, []))


def main() -> int:
    """Run the campaign; return 1 if a check is broken."""
    parser = argparse.ArgumentParser(prog="make campaign", description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="run every n-th strike only")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="store the rows there; leave the page alone")
    args = parser.parse_args()
    source = source_hash()

    def keep(rows: list[Row]) -> None:
        last = rows[-1]
        told = (len(rows), last["bench"], last["strike"], last["activity"], last["code"] or "none")
        sys.stdout.write(" ".join(map(str, (*told, *last["broken"]))) + "\n")
        sys.stdout.flush()
        if args.out is None:
            save(rows, source)
        else:
            write_atomically(args.out, json.dumps(rows, indent=0).encode())

    known = stored(source) if args.out is None else None
    rows = run(plan()[:: args.every], args.workers, keep, list(known["strikes"]) if known else [])
    for one in summary(rows):
        sys.stdout.write(f"{one.name}: {one.value} {one.unit} {one.note}\n")
    return int(any(row["broken"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
