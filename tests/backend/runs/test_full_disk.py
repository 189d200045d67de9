"""A disk that fills up while stacking pauses the run until there is space."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.backend.runs.oracle_bench import OracleSession, request
from touchdown.backend.annotations import storage
from touchdown.backend.core.events import (
    EpisodeRecorded,
    Event,
    FaultRaised,
    Paused,
    PhaseEntered,
    RunFinished,
    TrialFinished,
)
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import Outcome
from touchdown.backend.episodes.episode_file import read_episode
from touchdown.backend.runs.event_log import EventLog, encode_event, read_events
from touchdown.backend.runs.requests import RunState

ROOT = Path(__file__).resolve().parents[3]
CHILD = """
import json, resource, sys
from pathlib import Path
from touchdown.backend.core.events import EpisodeRecorded, Paused
from tests.backend.runs.oracle_bench import OracleSession, request

bench = OracleSession(runs=Path(sys.argv[1]))
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]

def fill(fact):
    # After each episode no file grows beyond 1 MB, until there is room: an episode takes 4.
    if isinstance(fact, EpisodeRecorded):
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))
    elif isinstance(fact, Paused) and sys.argv[3] == "resume":
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
        bench.session.engine.resume()

bench.session.events.subscribe(fill)
bench.session.run(request(seed=int(sys.argv[2]), trials=1))
bench.session.close()
codes = [fault.code for fault in bench.session.interlock.faults]
print(json.dumps([codes, bench.benches[-1].truth().stands, str(bench.session.run_folder)]))
"""


def _stacked(folder: Path, seed: int, then: str) -> tuple[list[str], bool, list[Event]]:
    """Return the latched fault codes, whether the piece stands, and the events."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(folder), str(seed), then],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    codes, stands, run = json.loads(done.stdout)
    return codes, stands, list(read_events(Path(run)))


@pytest.mark.promise("D2", "W18")
@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of POSIX")
def test_a_full_disk_pauses_the_run_which_goes_on_and_loses_nothing(tmp_path: Path) -> None:
    codes, stands, told = _stacked(tmp_path, 3, "resume")
    assert codes == []
    assert stands is True
    pauses = [fact for fact in told if isinstance(fact, Paused)]
    assert {fact.fault.code for fact in pauses} == {"DISK-FULL"}
    assert all("in memory" in fact.fault.consequence for fact in pauses)
    trial, run = told[-2:]
    assert isinstance(trial, TrialFinished)
    assert isinstance(run, RunFinished)
    assert (trial.outcome, run.ending) == (Outcome.PLACED, "finished")
    recorded = [fact for fact in told if isinstance(fact, EpisodeRecorded)]
    assert [fact.probe for fact in recorded] == list(range(1, trial.probes + 1))
    files = sorted(tmp_path.glob("*/episodes/*"))
    assert sorted(fact.path for fact in recorded) == [file.name for file in files]
    assert all(read_episode(file).quality.accepted for file in files)


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of POSIX")
def test_what_was_placed_stays_placed_where_nobody_makes_room(tmp_path: Path) -> None:
    # The second probe of this seed is the one that lets go: its episode is refused afterwards.
    codes, stands, told = _stacked(tmp_path, 7, "give up")
    assert codes == ["DISK-FULL"]
    assert stands is True
    assert [type(fact) for fact in told[-4:]] == [Paused, FaultRaised, TrialFinished, RunFinished]
    fault, trial, run = told[-3:]
    assert isinstance(fault, FaultRaised)
    assert isinstance(trial, TrialFinished)
    assert isinstance(run, RunFinished)
    assert str(tmp_path) in fault.fault.next_step
    assert (trial.outcome, run.ending) == (Outcome.PLACED, "failed")
    assert "The episode cannot be written" in run.reason
    # The one before is whole, and of the refused one nothing is left.
    (recorded,) = [fact for fact in told if isinstance(fact, EpisodeRecorded)]
    (file,) = tmp_path.glob("*/episodes/*")
    assert file.name == recorded.path
    assert read_episode(file).quality.accepted


@pytest.mark.promise("D2", "W18")
def test_a_run_is_refused_below_1_gb_and_pauses_before_the_next_probe_below_half_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = SimpleNamespace(free=900_000_000)
    monkeypatch.setattr(storage.shutil, "disk_usage", lambda _place: usage)
    bench = OracleSession(runs=tmp_path)
    with pytest.raises(InputError, match=r"Only 0\.90 GB are free; recording needs 1\.00 GB"):
        bench.session.run(request())
    assert bench.of(PhaseEntered) == []
    assert list(tmp_path.iterdir()) == []
    usage.free = 10**12
    states: list[tuple[RunState, str]] = []

    def watch(fact: Event) -> None:
        if isinstance(fact, EpisodeRecorded):
            usage.free = 420_000_000
        elif isinstance(fact, Paused):
            states.append((bench.session.status().state, fact.fault.what))

    bench.session.events.subscribe(watch)
    bench.session.run(request())
    bench.session.close()
    # Nobody resumed it: a run without a window ends, lifted, and says why.
    assert [state for state, _ in states] == [RunState.PAUSED]
    assert "Only 0.42 GB" in states[0][1]
    end = bench.of(RunFinished)[-1]
    assert isinstance(end, RunFinished)
    assert end.ending == "cancelled"
    assert "0.42 GB" in end.reason
    assert len(bench.of(EpisodeRecorded)) == 1
    assert bench.session.interlock.faults == ()


@pytest.mark.promise("D2")
def test_a_journal_without_room_is_held_in_memory_and_written_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = OracleSession(runs=tmp_path)
    plain, full = EventLog._append, []

    def torn(journal: EventLog, line: dict[str, object]) -> None:
        if full:
            journal._file.write(b'{"torn":')
            journal._file.flush()
            raise OSError(errno.ENOSPC, "No space left on device")
        plain(journal, line)

    def watch(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "press":
            full.append(fact)
        elif isinstance(fact, Paused):
            full.clear()
            bench.session.engine.resume()

    monkeypatch.setattr(EventLog, "_append", torn)
    bench.session.events.subscribe(watch)
    bench.session.run(request())
    folder = bench.session.run_folder
    bench.session.close()
    assert folder is not None
    # Before the second probe and at the end: both presses had filled the disk.
    assert [fact.fault.device for fact in bench.of(Paused) if isinstance(fact, Paused)] == [
        "store",
        "store",
    ]
    assert [encode_event(fact) for fact in read_events(folder)] == [
        encode_event(fact) for fact in bench.facts
    ]
    assert bench.session.interlock.faults == ()
