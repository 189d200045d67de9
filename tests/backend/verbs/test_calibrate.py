"""``touchdown calibrate``: what is acceptable can be kept, and status says what lacks."""

from __future__ import annotations

import argparse
import io
import json
import re
import shlex
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.calibration.records import CalibrationStore, read_record
from touchdown.backend.calibration.result import CALIBRATION_NAMES, CalibrationEstimate, Quantity
from touchdown.backend.cli import calibrate
from touchdown.backend.cli.command_line import main
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core.events import RunFinished
from touchdown.backend.runs.recorder import calibrations_folder

GOOD = CalibrationEstimate(
    (
        Quantity("mass_kg", 1.5, 0.01, "kg"),
        Quantity("com_x_mm", 0.0, 0.1, "mm"),
        Quantity("com_y_mm", 0.0, 0.1, "mm"),
    ),
    np.eye(3), np.zeros(6), 0.05, 0.3, "N", note="Level.",
).to_event(0.0, "payload")  # fmt: skip


class Bench:
    """A session as far as a report needs one."""

    devices: dict[str, object] = {}  # noqa: RUF012

    def __init__(self, folder: Path) -> None:
        self.calibrations = CalibrationStore(folder, "simulated")


def reported(folder: Path, found, *, accept: bool) -> tuple[int, dict]:
    stream = io.StringIO()
    screen = VerbOutput(json=True, stream=stream)
    told = calibrate._CalibrationProgress(screen, None, None)
    told.take(RunFinished(1.0, "r", "finished", "Done."))
    if found is not None:
        told.take(found)
    args = argparse.Namespace(what="payload", accept=accept, person="Ada")
    code = calibrate._report(args, Bench(folder), told, screen)
    return code, json.loads(stream.getvalue())


def test_a_good_result_is_kept_only_when_accepted(tmp_path) -> None:
    code, told = reported(tmp_path, GOOD, accept=False)
    assert (code, told["accepted"], list(tmp_path.iterdir())) == (0, None, [])
    assert told["measured"]["values"]["mass_kg"] == {"value": 1.5, "sigma": 0.01, "unit": "kg"}
    code, told = reported(tmp_path, GOOD, accept=True)
    assert code == 0
    assert read_record(Path(told["accepted"])).file.person == "Ada"


@pytest.mark.parametrize("change", [{"residual": 0.4}, {"obstacle": "Turn ft.rotation."}])
def test_a_bad_result_is_never_kept(tmp_path, change) -> None:
    code, told = reported(tmp_path, replace(GOOD, **change), accept=True)
    assert (code, told["accepted"], told["measured"]["acceptable"]) == (1, None, False)
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_ended_early_is_no_result(tmp_path) -> None:
    code, told = reported(tmp_path, None, accept=True)
    assert (code, told["measured"], told["reason"]) == (1, None, "Done.")


def test_status_says_what_lacks_and_what_to_do(capsys) -> None:
    store = CalibrationStore(calibrations_folder(), "simulated")
    store.accept(GOOD, {}, now=datetime.now(UTC))
    assert main(["calibrate", "status"]) == 1
    said = capsys.readouterr().out
    assert "Run 'touchdown calibrate board --accept'." in " ".join(said.split())
    assert main(["calibrate", "status", "--json"]) == 1
    rows = json.loads(capsys.readouterr().out)["calibrations"]
    assert [row["what"] for row in rows] == list(CALIBRATION_NAMES)
    assert [row["condition"] for row in rows] == ["valid"] + 4 * ["missing"]


LAB = """version = 1
name = "Here"
kind = "emulated"
[mounting]
sensor_height_mm = 120.0
sensor_yaw_rad = 0.0
payload_kg = 1.5
payload_com_mm = [0.0, 0.0, 60.0]
[melfa]
host = "127.0.0.1"
[wsg]
host = "127.0.0.1"
[ft]
driver = "dynpick"
address = "socket://127.0.0.1:5000"
[gelsight]
by_id = "/srv/by-id"
[gelsight.left]
serial = "L"
[gelsight.right]
serial = "R"
"""


def test_the_command_that_status_names_works_as_it_is_pasted(tmp_path, capsys) -> None:
    """It homes a lab's gripper, and keeps what was asked for: bench, speed, place, folder."""
    lab = tmp_path / "a lab.toml"
    lab.write_text(LAB)
    words = ["--bench", str(lab), "--override", "100", "--bottom", "square15",
             "--origin", "1.5", "-2", "--person", "Ada L"]  # fmt: skip
    assert main(["calibrate", "status", *words]) == 1
    said = " ".join(capsys.readouterr().out.split())
    given = re.findall(r"Run 'touchdown (calibrate .*?--accept)'\.", said)
    assert [shlex.split(command)[1] for command in given] == list(CALIBRATION_NAMES)
    parser = argparse.ArgumentParser()
    calibrate.add_arguments(parser)
    pasted = parser.parse_args(shlex.split(given[0])[1:])
    assert (pasted.bench, pasted.home, pasted.override) == (str(lab), True, 100)
    assert (pasted.bottom, pasted.origin, pasted.person) == ("square15", [1.5, -2.0], "Ada L")
    assert pasted.accept


def test_status_of_another_simulated_bench_names_it(tmp_path, capsys) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text('preset = "off"\n')
    assert main(["calibrate", "status", "--bench", str(bench), "--pitch", "2"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert f"touchdown calibrate board --bench {bench} --pitch 2.0 --accept" in said


@pytest.mark.parametrize(
    ("at_lab", "flag"),
    [(False, "--home"), (False, "--override=50"), (True, "--emulated"), (True, "--preset=quiet")],
)
@pytest.mark.parametrize("what", ["payload", "status"])
def test_what_the_bench_has_no_use_for_is_refused_not_passed_over(
    tmp_path, capsys, at_lab, flag, what
) -> None:
    lab = tmp_path / "lab.toml"
    lab.write_text(LAB)
    assert main(["calibrate", what, flag, *(["--bench", str(lab)] if at_lab else [])]) == 2
    assert flag.split("=")[0] in capsys.readouterr().err


def test_a_board_that_is_not_there_is_said_with_exit_code_1(tmp_path, capsys) -> None:
    bench = tmp_path / "bench.toml"
    # Few pictures: none of them matters here.
    bench.write_text('preset = "off"\n[tactile]\nrate_hz = 4.0\n')
    words = ["board", "--origin", "40", "0", "--bench", str(bench), "--json"]
    assert main(["calibrate", *words]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["ending"] == "failed"
    assert "No contact at the expected centre" in told["reason"]
    assert told["measured"] is None


def test_senseless_words_are_refused(capsys) -> None:
    assert main(["calibrate", "camera", "--pitch", "0"]) == 2
    assert "--pitch" in capsys.readouterr().err
    assert main(["calibrate", "board", "--hand-over", "--json"]) == 2
