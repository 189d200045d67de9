"""Settings of the method as a file: written, changed, used and refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.cli.settings import as_toml, load_method
from touchdown.backend.config.method import StackSettings
from touchdown.backend.runs.event_log import EVENT_LOG_NAME


def test_what_is_written_is_read_back_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "method.toml"
    assert main(["settings", "--write", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["method"]["stability"]["delta"] == 0.9
    assert told["written"] == str(path)
    assert load_method(path) == StackSettings()
    changed = path.read_text("utf-8").replace("[30.0, 30.0, 15.0]", "[20, 20.0, 1e1]")
    path.write_text(changed.replace('"area"', '"cells"').replace("false", "true"), "utf-8")
    settings = load_method(path)
    assert settings.probe.stiffness_n_mm == (20.0, 20.0, 10.0)
    assert (settings.policy.hull_centre, settings.belief.prior_correction) == ("cells", True)
    again = tmp_path / "again.toml"
    again.write_text(as_toml(settings), "utf-8")
    assert load_method(again) == settings


def test_a_file_is_never_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "method.toml"
    path.write_text("mine", "utf-8")
    assert main(["settings", "--write", str(path), "--json"]) == 2
    assert json.loads(capsys.readouterr().err)["error"]["where"] == str(path)
    assert path.read_text("utf-8") == "mine"


def test_a_run_follows_the_file_and_records_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "method.toml"
    path.write_text("[policy]\nmax_probes = 1\n", "utf-8")
    runs = tmp_path / "runs"
    words = ["stack", "--seed", "7", "--method", str(path), "--runs", str(runs), "--no-episodes"]
    assert main([*words, "--json"]) == 1
    (trial,) = json.loads(capsys.readouterr().out)["trials"]
    assert (trial["outcome"], trial["probes"]) == ("gave_up", 1)
    head = (next(runs.glob("*")) / EVENT_LOG_NAME).read_text("utf-8").splitlines()[1]
    method = json.loads(json.loads(head)["settings"])["method"]
    assert method["policy"]["max_probes"] == 1
    assert method["stability"]["delta"] == 0.9


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[policy]\nmax_probs = 1\n", "policy.max_probs"),
        ("[stability]\ndelta = 1.5\n", "stability.delta"),
        ("[policy]\nmax_probes = \n", "TOML"),
        ('strategy = "paper"\n', "strategy"),
    ],
)
def test_a_bad_file_is_one_error_and_leaves_nothing(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "method.toml"
    path.write_text(text, "utf-8")
    runs = tmp_path / "runs"
    assert main(["stack", "--method", str(path), "--runs", str(runs), "--json"]) == 2
    error = json.loads(capsys.readouterr().err)["error"]
    assert error["where"] == str(path)
    assert said in error["what"] + error["fix"]
    assert not runs.exists()
