"""A disk that refuses an episode: one fault, a whole journal, earlier episodes intact."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from backend.core.facts import EpisodeRecorded, Fact, FaultRaised, RunFinished, TrialFinished
from backend.core.flow import Outcome
from backend.dataset.episode_reading import read_episode
from backend.runs.journal import read_journal

ROOT = Path(__file__).resolve().parents[3]
CHILD = """
import json, resource, sys
from pathlib import Path
from backend.core.facts import EpisodeRecorded
from tests.backend.runs.oracle_bench import OracleSession, request

bench = OracleSession(runs=Path(sys.argv[1]))
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]

def fill(fact):
    # From the first episode on no file grows beyond 1 MB: an episode takes 4, the journal 0.3.
    if isinstance(fact, EpisodeRecorded):
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))

bench.session.hub.subscribe(fill)
bench.session.run(request(seed=int(sys.argv[2]), trials=2))
bench.session.close()
codes = [fault.code for fault in bench.session.interlock.faults]
print(json.dumps([codes, bench.benches[-1].truth().stands, str(bench.session.run_folder)]))
"""
PROBES = {7: 2, 3: 3}
"""Seed: probes of its first trial, so that the second one is or is not that of the release."""


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of POSIX")
@pytest.mark.parametrize("seed", PROBES)
def test_an_episode_that_the_disk_refuses_ends_the_run_in_order(tmp_path: Path, seed: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path), str(seed)],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    codes, stands, folder = json.loads(done.stdout)
    assert codes == ["EPISODE-FAILED"]
    told = list(read_journal(Path(folder)))
    assert [type(fact) for fact in told[-3:]] == [FaultRaised, TrialFinished, RunFinished]
    fault, trial, run = told[-3:]
    assert isinstance(fault, FaultRaised)
    assert isinstance(trial, TrialFinished)
    assert isinstance(run, RunFinished)
    assert str(tmp_path) in fault.fault.next_step
    assert run.ending == "failed"
    assert "The episode cannot be written" in run.reason
    assert trial.probes == 2
    # A piece that was let go is where it is, whatever the disk says; else it stays in the gripper.
    released = PROBES[seed] == 2
    assert stands is (True if released else None)
    assert trial.outcome is (Outcome.PLACED if released else Outcome.ABORTED)
    _first_episode_only(told, Path(folder))


def _first_episode_only(told: list[Fact], folder: Path) -> None:
    (recorded,) = [fact for fact in told if isinstance(fact, EpisodeRecorded)]
    files = sorted((folder / "episodes").iterdir())
    # The one kept is whole, and of the refused one nothing is left.
    assert [file.name for file in files] == [recorded.path]
    assert read_episode(files[0]).quality.accepted
