"""``stack`` and ``replay`` as scripts see them: JSON contract, exit codes, one clear error."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

from tests.backend.brisk import RATE_HZ
from touchdown.backend.cli.command_line import main
from touchdown.backend.core.events import RunStarted
from touchdown.backend.episodes.episode_file import read_episode
from touchdown.backend.runs.event_log import EVENT_LOG_NAME, EventLog
from touchdown.backend.simulation.release_mujoco import mujoco_available

TRIAL_KEYS = {
    "seed",
    "outcome",
    "reason",
    "probes",
    "excess_probes",
    "margin_mm",
    "contradicted",
}
OUTCOMES = {"placed", "fell", "knocked_over", "gave_up", "aborted"}


@pytest.fixture
def bench(tmp_path: Path) -> str:
    """Settings of a bench with half the pictures."""
    path = tmp_path / "bench.toml"
    path.write_text(f"[tactile]\nrate_hz = {RATE_HZ}\n", "utf-8")
    return str(path)


def call(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    status = main([*words, "--json"])
    told = capsys.readouterr()
    return status, told.out, told.err


def test_stack_then_replay_tell_the_same(
    tmp_path: Path, bench: str, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = str(tmp_path / "runs")
    words = ("stack", "--piece", "pot", "--bottom", "short", "--seed", "0", "--runs", runs)
    words += ("--bench", bench)
    status, out, err = call(capsys, *words)
    told = json.loads(out)
    assert err == ""
    assert {"piece", "bottom", "strategy", "trials"} <= set(told)
    (trial,) = told["trials"]
    assert set(trial) == TRIAL_KEYS
    assert trial["outcome"] in OUTCOMES
    # The second judge was asked, where there is one.
    assert trial["contradicted"] in ((False, True) if mujoco_available() else (None,))
    assert status == (0 if trial["outcome"] == "placed" else 1)
    status, out, err = call(capsys, "replay", "latest", "--runs", runs)
    again = json.loads(out)
    assert status == 0
    assert again["trials"][0]["probes"] == trial["probes"]
    assert again["facts"]["EpisodeRecorded"] == trial["probes"]
    episodes = list((tmp_path / "runs").glob("*/episodes/*.mcap"))
    assert len(episodes) == trial["probes"]


def test_the_shipped_model_is_the_one_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    call(capsys, "stack", "--inject", "tactile_left:stop@0.5", "--runs", str(runs))
    head = (next(runs.glob("*")) / EVENT_LOG_NAME).read_text("utf-8").splitlines()[1]
    settings = json.loads(json.loads(head)["settings"])
    assert set(settings) == {
        "request", "method", "simulation", "disturbances", "model", "program", "limits",
    }  # fmt: skip
    assert settings["disturbances"] == ["tactile_left:stop@0.5"]
    assert len(settings["model"]["weights_sha256"]) == 64


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (("--piece", "nope"), "nope"),
        (("--piece", "short"), "short"),
        (("--bottom", "nope"), "nope"),
        (("--bottom", ""), "--bottom"),
        (("--bottom", "pot+short"), ""),
        (("--model", "no/such/file.safetensors"), "no/such/file.safetensors"),
        (("--bench", "no/such/file.toml"), "no/such/file.toml"),
        (("--preset", "easy"), "preset"),
        (("--inject", "camera"), "camera"),
        (("--trials", "0"), "--trials"),
        (("--seed", "-1"), "--seed"),
        (("--pieces", "no/such/folder"), "no/such/folder"),
    ],
)
def test_bad_input_is_one_error_and_leaves_nothing_behind(
    words: tuple[str, ...], where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    status, out, err = call(capsys, "stack", *words, "--runs", str(runs))
    assert status == 2
    assert out == ""
    error = json.loads(err)["error"]
    assert set(error) == {"what", "where", "fix"}
    assert where in error["where"]
    assert all(error.values())
    assert not runs.exists()


def test_a_run_killed_in_the_middle_replays_to_its_last_fact(
    tmp_path: Path, bench: str, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    command = [sys.executable, "-m", "touchdown", "stack", "--trials", "50", "--runs", str(runs)]
    command += ["--bench", bench]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ) as child:
        assert child.stdout is not None
        for line in child.stdout:
            if b"Probe 2" in line:
                break
        child.send_signal(signal.SIGKILL)
        child.wait(60)
    status, out, _ = call(capsys, "replay", "latest", "--runs", str(runs))
    told = json.loads(out)
    assert status == 0
    assert told["ending"] == "interrupted"
    assert told["facts"]["ActionChosen"] >= 2
    assert told["facts"]["EpisodeRecorded"] >= 1
    (folder,) = runs.glob("*")
    kept = {path.stem for path in folder.glob("episodes/*.mcap")}
    lines = [json.loads(line) for line in (folder / EVENT_LOG_NAME).read_bytes().splitlines()[1:]]
    told_ids = {f["episode"]["episode_id"] for f in lines if f["kind"] == "EpisodeRecorded"}
    assert told_ids <= kept


def test_a_runs_folder_that_cannot_be_written_is_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    occupied = tmp_path / "file"
    occupied.write_text("not a folder")
    status, out, err = call(capsys, "stack", "--runs", str(occupied))
    assert status == 2
    assert out == ""
    assert str(occupied) in json.loads(err)["error"]["where"]


def test_ctrl_c_lifts_tells_the_result_and_closes_the_journal(
    tmp_path: Path, bench: str, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    command = [sys.executable, "-m", "touchdown", "stack", "--trials", "50", "--runs", str(runs)]
    command += ["--bench", bench]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ) as child:
        assert child.stdout is not None
        for line in child.stdout:
            if b"Probe 1" in line:
                break
        child.send_signal(signal.SIGINT)
        rest = child.stdout.read().decode()
        status = child.wait(60)
    assert status == 1
    assert "aborted" in rest
    assert "Kept in" in rest
    told = json.loads(call(capsys, "replay", "latest", "--runs", str(runs))[1])
    assert told["ending"] == "cancelled"
    assert told["trials"][-1]["outcome"] == "aborted"


def test_an_operators_own_piece_can_be_stacked_upon(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = Path(__file__).parents[3] / "resources" / "objects" / "short.toml"
    folder = tmp_path / "pieces"
    folder.mkdir()
    (folder / "mystub.toml").write_text(shipped.read_text("utf-8"), "utf-8")
    words = ("--pieces", str(folder), "--bottom", "mystub", "--strategy", "pick-and-place")
    status, out, _ = call(capsys, "stack", *words, "--runs", str(tmp_path / "runs"))
    assert status == 1
    assert json.loads(out)["trials"][0]["outcome"] == "fell"


def test_pick_and_place_asks_for_no_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pieces = tmp_path / "pieces"
    pieces.mkdir()
    text = files("touchdown.resources").joinpath("objects", "pot.toml").read_text("utf-8")
    (pieces / "own.toml").write_text(text, "utf-8")
    runs = tmp_path / "runs"
    words = ("stack", "--piece", "own", "--pieces", str(pieces), "--runs", str(runs))
    status, _, err = call(capsys, *words)
    assert status == 2
    assert "No model ships for piece 'own'" in err
    status, out, err = call(capsys, *words, "--strategy", "pick-and-place")
    assert err == ""
    assert (status, json.loads(out)["trials"][0]["outcome"]) == (1, "fell")
    head = (next(runs.glob("*")) / EVENT_LOG_NAME).read_text("utf-8").splitlines()[1]
    assert json.loads(json.loads(head)["settings"])["model"] is None
    # A model that was named is read all the same: a wrong name is not passed over.
    status, _, err = call(
        capsys, *words, "--strategy", "pick-and-place", "--model", "no.safetensors"
    )
    assert status == 2
    assert "no.safetensors" in err


def test_a_camera_that_falls_silent_ends_in_one_fault_and_keeps_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    words = ("stack", "--seed", "7", "--trials", "2", "--runs", str(runs))
    status, out, err = call(capsys, *words, "--inject", "tactile_right:stop@7.0")
    told = json.loads(out)
    assert (status, err, told["faults"]) == (1, "", ["CAMERA-STALE"])
    # The first probe was over by then; the trial is aborted and no other one is begun.
    (trial,) = told["trials"]
    assert trial["outcome"] == "aborted"
    assert "CAMERA-STALE" in trial["reason"]
    assert len(list(runs.glob("*/episodes/*.mcap"))) == 1
    status, out, _ = call(capsys, "replay", "latest", "--runs", str(runs))
    again = json.loads(out)
    assert (status, again["ending"]) == (0, "failed")
    assert again["facts"]["EpisodeRecorded"] == 1
    assert again["facts"]["FaultRaised"] == 1


def test_a_camera_silent_for_a_moment_costs_one_probe(
    tmp_path: Path, bench: str, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = ("--runs", str(tmp_path / "runs"), "--bench", bench)
    status, out, _ = call(
        capsys, "stack", "--seed", "7", *runs, "--inject", "tactile_left:stop@4.0+0.4"
    )
    told = json.loads(out)
    assert told["faults"] == []
    assert (status, told["trials"][0]["outcome"]) == (0, "placed")
    episodes = list((tmp_path / "runs").glob("*/episodes/*.mcap"))
    refused = [path for path in episodes if not read_episode(path).quality.accepted]
    assert len(refused) == 1
    assert any("tactile_left" in r or "left" in r for r in read_episode(refused[0]).quality.reasons)


def test_a_run_of_a_removed_strategy_still_replays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    journal = EventLog(folder)
    journal(RunStarted(0.0, "stack", "pot", "short", "pressure", 7, 1, True, "{}"))
    journal.close()
    assert main(["replay", str(folder), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["piece"], result["facts"]) == ("pot", {"RunStarted": 1})


def test_a_method_file_with_an_unknown_setting_is_one_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    method = tmp_path / "old.toml"
    method.write_text("[contours]\nrisk = 0.05\n", "utf-8")
    assert main(["settings", "--method", str(method)]) == 2
    assert "There is no setting 'contours'." in capsys.readouterr().err
