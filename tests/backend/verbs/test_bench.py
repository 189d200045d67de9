"""``touchdown bench``, and what other verbs refuse of a lab file before touching a device."""

import json

import pytest

from backend.__main__ import main


@pytest.fixture
def lab(tmp_path, capsys):
    path = tmp_path / "lab.toml"
    assert main(["bench", str(path), "--new"]) == 0
    capsys.readouterr()
    return path


def test_a_new_file_is_read_back_with_what_is_still_made_up(lab, capsys):
    assert main(["bench", str(lab), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["name"], told["kind"], told["limits"]["trip_n"]) == ("My lab", "hardware", 40.0)
    assert told["devices"]["arm"] == "melfa 192.168.0.20:10001"
    assert "melfa.mxt.error_overspeed" in told["placeholders"]
    assert main(["bench", str(lab)]) == 0
    assert "put in the lab's own numbers" in capsys.readouterr().out


def test_a_file_that_is_there_is_not_overwritten(lab, capsys):
    assert main(["bench", str(lab), "--new"]) == 2
    assert str(lab) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["stack", "--home"], "--home"),
        (["collect", "--override", "20"], "--override"),
        (["stack", "--bench", "LAB", "--preset", "quiet"], "--preset"),
        (["stack", "--bench", "LAB", "--emulated"], "--emulated"),
        (["stack", "--bench", "LAB", "--json"], "--mode"),
        (["collect", "--bench", "LAB", "--json"], "--hand-over"),
        (["doctor", "--bench", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_what_does_not_go_together_is_one_clear_error(lab, capsys, words, where):
    assert main([str(lab) if word == "LAB" else word for word in words]) == 2
    told = capsys.readouterr().err
    assert where in (json.loads(told)["error"]["where"] if "--json" in words else told)
