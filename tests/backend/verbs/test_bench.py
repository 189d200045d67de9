"""``touchdown bench``, and what other verbs refuse of a lab file before touching a device."""

import io
import json
import re
from argparse import ArgumentParser

import pytest
from rich.console import Console

from touchdown.backend.cli import collect, stack
from touchdown.backend.cli.bench import _timing_table
from touchdown.backend.cli.command_line import main
from touchdown.backend.cli.connection import fill_in_scene
from touchdown.backend.rig.diagnostics import SensorTiming


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
    blank = {"ft.address", "gelsight.left.serial", "gelsight.right.serial"}
    assert {"melfa.mxt.error_overspeed"} | blank <= set(told["placeholders"])
    assert main(["bench", str(lab)]) == 0
    assert "enter the values of the lab" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("table", "key"),
    [("[ft]", "ft"), ("[gelsight]", "gelsight"), ("[wsg]", "wsg"), ("[melfa]", "melfa")],
)
def test_a_driver_that_nobody_offers_is_named_before_anything_is_connected(lab, capsys, table, key):
    text = re.sub(r"(?m)^driver = .*\n", "", lab.read_text("utf-8"))
    lab.write_text(text.replace(table, f'{table}\ndriver = "mine"'), "utf-8")
    assert main(["bench", str(lab)]) == 2
    told = capsys.readouterr().err
    assert "There is no driver 'mine'." in told
    assert f"{lab}, {key}.driver" in told.replace("\n", "")
    assert "install the package that offers it" in " ".join(told.split())


@pytest.mark.parametrize("verb", ["stack", "collect"])
def test_a_campaign_on_hardware_without_calibrations_connects_nothing(
    lab, capsys, tmp_path, monkeypatch, verb
):
    monkeypatch.setenv("TOUCHDOWN_DATA", str(tmp_path / "data"))
    assert main([verb, "--bench", str(lab), "--home"]) == 1
    told = capsys.readouterr()
    assert "Payload: never calibrated on this bench." in told.err
    assert "where: CALIBRATION-MISSING" in told.err
    command = f"Run 'touchdown calibrate payload --bench {lab} --home --accept'."
    assert f"fix:   {command}" in " ".join(told.err.split("\n")).replace("  fix", "fix")
    assert "homing" not in told.out
    assert "force_torque" not in told.out


def test_what_stands_there_is_what_the_lab_file_says_unless_it_is_named(lab):
    text = lab.read_text("utf-8").replace('bottom = "short"', 'bottom = "square15"')
    lab.write_text(text.replace('piece = "pot"', 'piece = "barrel"'), "utf-8")

    def scene(verb, *words):
        parser = ArgumentParser()
        verb.add_arguments(parser)
        args = parser.parse_args(words)
        fill_in_scene(args, verb.BOTTOM)
        return args.piece, args.bottom

    for verb in (collect, stack):
        assert scene(verb, "--bench", str(lab)) == ("barrel", "square15")
        assert scene(verb, "--bench", str(lab), "--bottom", "hex20") == ("barrel", "hex20")
        assert scene(verb) == ("pot", verb.BOTTOM)


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


def test_the_table_of_times_is_whole_in_a_terminal_of_80_columns() -> None:
    timing = SensorTiming("tactile_right", 595, 200.0, 1020.3, 1150.9, 1225.2, 1129.4)
    text = io.StringIO()
    Console(file=text, width=80).print(_timing_table([timing]))
    assert all(figure in text.getvalue() for figure in ("595", "1020.3", "1225.2", "1129.4"))
    assert "99 %" in text.getvalue()
