"""``touchdown bench``, and what other verbs refuse of a lab file before touching a device."""

from __future__ import annotations

import argparse
import io
import json
import re
import shlex
import shutil
import sqlite3
import sys
import threading
from argparse import ArgumentParser
from contextlib import ExitStack, closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from queue import Queue
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.annotations.conftest import context_for, small_episode
from tests.backend.bench.brisk import CYCLE_US, RATE_HZ
from tests.backend.exchange.conftest import fill
from touchdown.backend.annotations import Dataset, Label, list_backups
from touchdown.backend.calibration.records import CalibrationStore, read_record
from touchdown.backend.calibration.result import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    CalibrationEstimate,
    Quantity,
)
from touchdown.backend.cli import calibrate, collect, dataset, main, stack, train
from touchdown.backend.cli.bench import _show_timing
from touchdown.backend.cli.collect import coverage_text
from touchdown.backend.cli.connection import (
    RunProgress,
    answer_prompt,
    fill_in_scene,
    wait_for_disk_space,
)
from touchdown.backend.cli.output import VerbOutput, progress_lines
from touchdown.backend.config import load_lab
from touchdown.backend.core import (
    Fault,
    HandOverAwaited,
    MountingAwaited,
    PhaseEntered,
    RunFinished,
)
from touchdown.backend.episodes.quality import count_coverage
from touchdown.backend.geometry.outlines import circle
from touchdown.backend.rig.diagnostics import SensorTiming
from touchdown.backend.runs.campaign import new_campaign
from touchdown.backend.runs.recorder import calibrations_folder


def test_a_new_file_is_read_back_with_what_is_still_made_up(lab, capsys):
    assert main(["bench", str(lab), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["name"], told["kind"], told["limits"]["trip_n"]) == ("My lab", "hardware", 40.0)
    assert told["devices"]["arm"] == "melfa 192.168.0.20:10001"
    blank = {"ft.address", "gelsight.left.serial", "gelsight.right.serial"}
    assert {"melfa.mxt.error_overspeed"} | blank <= set(told["placeholders"])
    assert main(["bench", str(lab)]) == 0
    assert "enter the values of the lab" in capsys.readouterr().out
    assert main(["bench", str(lab), "--new"]) == 2, "it is not overwritten"
    assert str(lab) in capsys.readouterr().err


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
) -> None:
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


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["stack", "--home"], "--home"),
        (["collect", "--override", "20"], "--override"),
        (["stack", "--bench", "LAB", "--preset", "quiet"], "--preset"),
        (["stack", "--bench", "LAB", "--emulated"], "--emulated"),
        (["stack", "--bench", "LAB", "--json"], "--mode"),
        (["collect", "--bench", "LAB", "--json"], "--hand-over"),
        (["calibrate", "board", "--hand-over", "--json"], "--hand-over"),
        (["calibrate", "camera", "--pitch", "0"], "--pitch"),
        (["calibrate", "camera", "--pitch", "inf"], "--pitch"),
        (["doctor", "--bench", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_what_does_not_go_together_is_one_clear_error(lab, capsys, words, where):
    assert main([str(lab) if word == "LAB" else word for word in words]) == 2
    told = capsys.readouterr().err
    assert where in (json.loads(told)["error"]["where"] if "--json" in words else told)


def test_the_table_of_times_is_whole_in_a_terminal_of_80_columns(monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    timing = SensorTiming("tactile_right", 595, 200.0, 1020.3, 1150.9, 1225.2, 1129.4)
    _show_timing([timing], VerbOutput())
    text = capsys.readouterr().out
    shown = ("tactile_right", "595", "200.0", "1020.3", "1150.9", "1225.2", "1129.4", "99 %")
    assert all(figure in text for figure in shown)


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
    told = calibrate._CalibrationProgress("Calibrating", screen, None, None)
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
    code, told = reported(tmp_path, None, accept=True)
    assert (code, told["measured"], told["reason"]) == (1, None, "Done.")
    assert list(tmp_path.iterdir()) == []


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


def test_the_last_check_the_gels_and_what_they_mean_are_shown(lab, capsys) -> None:
    text = lab.read_text("utf-8").replace('"FILL-IN1" }', '"FILL-IN1", gel = "B" }')
    lab.write_text(text.replace("daily_check = false", "daily_check = true"), "utf-8")
    assert main(["check-day", "--last", "--bench", str(lab)]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "There is no daily check of today: each release is asked." in said
    assert f"Run 'touchdown check-day --bench {lab} --home'." in said
    store = CalibrationStore(lab.parent / "calibrations", "hardware", gels=("A", ""))
    store.accept(
        replace(
            GOOD,
            what="camera",
            names=CALIBRATION_KINDS["camera"].values,
            values=4 * (0.06,),
            sigmas=4 * (0.01,),
            units=4 * ("mm/px",),
        ),
        {},
    )
    store.gels.take(PhaseEntered(0.0, "press", 1))
    checks = store.day_checks(load_lab(lab).identity)
    checks.judge(replace(GOOD, what="day", names=("wrist_noise_n",), values=(0.3,)))
    assert main(["check-day", "--last", "--bench", str(lab), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["last"]["limits"] == {"wrist_noise_n": [0.0, 0.2]}
    assert told["findings"][0].startswith("Noise at rest, wrist sensor: 0.3, above 0.2 N.")
    assert (
        "is out of limits (noise at rest, wrist sensor): each release is asked." in told["withheld"]
    )
    assert told["gels"][0].startswith("Left gel B: 0 presses since ")
    assert re.match(r"Cameras: the left gel was replaced on .* \(A by B\)\. Run", told["gels"][1])


def test_the_command_that_status_names_works_as_it_is_pasted(lab, capsys) -> None:
    """It homes a lab's gripper, and keeps what was asked for: bench, speed, place, folder."""
    lab = lab.rename(lab.with_name("a lab.toml"))
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
    lab, capsys, at_lab, flag, what
) -> None:
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


def test_each_campaign_has_a_seed_of_its_own_unless_one_is_named(data_set) -> None:
    parser = ArgumentParser()
    collect.add_arguments(parser)

    def seed(*words: str) -> int:
        with Dataset.open(data_set, write=False) as opened:
            return collect._request(parser.parse_args(list(words)), opened, "ann").seed

    assert seed() != seed()
    assert (seed("--seed", "7"), seed("--seed", "0")) == (7, 0)


@pytest.mark.slow
def test_a_campaign_is_collected_and_resumed(tmp_path, capsys) -> None:
    bench = tmp_path / "bench.toml"
    settings = f'preset = "quiet"\ncycle_us = {CYCLE_US}\n[tactile]\nrate_hz = {RATE_HZ}\n'
    bench.write_text(settings, "utf-8")
    words = ["--dataset", str(tmp_path / "ds"), "--runs", str(tmp_path / "runs")]
    words += ["--bench", str(bench)]
    given = ["--count", "2", "--probes-per-grip", "2", "--person", "ann"]
    assert main(["collect", *given, *words, "--json", "--inject", "force_torque:stop@14"]) == 1
    first = json.loads(capsys.readouterr().out)
    assert first["ending"] == "failed"
    assert (first["faults"] != [], first["seed"]) == (True, 0)
    assert (first["collected"], first["count"], first["simulated"]) == (1, 2, True)
    for name, value in (("piece", "mushroom"), ("bottom", "short"), ("count", "3"), ("seed", "7"),
                        ("pattern", "grid"), ("within", "2")):  # fmt: skip
        capsys.readouterr()
        assert main(["collect", "--resume", f"--{name}", value, *words]) == 2
        assert f"The campaign was begun with {'no ' * (name == 'within')}--{name}" in (
            " ".join(capsys.readouterr().err.split())
        )
    same = ["--piece", "pot", "--count", "2"]
    assert main(["collect", "--resume", "--person", "bob", *same, *words]) == 0
    second = capsys.readouterr().out
    for said in (first["campaign"], "2 of 2 probes are done.", "no findings"):
        assert said in second
    # A later campaign does not hide an earlier one that is named.
    assert main(["collect", "--count", "1", "--person", "ann", *words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["campaign"] != first["campaign"]
    assert main(["collect", "--resume", first["campaign"], "--person", "ann", *words]) == 0
    assert f"campaign {first['campaign']}" in " ".join(capsys.readouterr().out.split())
    assert main(["collect", "--resume", "of-nobody", "--person", "ann", *words]) == 2
    assert "of-nobody.json" in capsys.readouterr().err
    with Dataset.open(tmp_path / "ds", write=False) as dataset:
        assert [entry.person for entry in dataset.episodes()] == ["ann", "bob", "ann"]
    assert (tmp_path / "runs").is_dir()
    # Presses that are to slip are no observations, so none of them counts as collected.
    assert main(["collect", "--plan", "drag", "--count", "1", "--person", "ann", *words]) == 0
    assert "kept for identify, which needs them to slip: 3." in " ".join(
        capsys.readouterr().out.split()
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--count", "0"], "'count': Input should be greater than or equal to 1"),
        (["--count", "100000000"], "'count': Input should be less than"),
        (["--within", "-1"], "'within_mm': Input should be greater than 0"),
        (["--seed", "-2"], "The seed is -2."),
        (["--origin", "nan", "0"], "The origin is (nan, 0.0)."),
        (["--origin-sigma", "nan"], "no uncertainty of the origin"),
        (["--origin-sigma", "-1"], "no uncertainty of the origin"),
        (["--piece", "cup"], "no piece 'cup'"),
        (["--probes-per-grip", "0"], "'probes_per_grip': Input should be greater than or"),
        (["--preset", "calm"], "no preset 'calm'"),
        (["--within", "0.001"], "Not enough displacements within 0.001 mm"),
        (["--hand-over", "--json"], "With --json the prompt"),
    ],
)
def test_bad_input_is_one_clear_error(words, said, tmp_path, capsys) -> None:
    where = ["--dataset", str(tmp_path / "ds"), "--runs", str(tmp_path / "runs")]
    assert main(["collect", *words, *where]) == 2
    out, err = capsys.readouterr()
    assert (out, said in err) == ("", True)
    assert err.count("\n") <= 3
    assert not (tmp_path / "ds").exists(), "no empty dataset is left"


def test_a_dataset_that_cannot_be_made_is_one_clear_error(tmp_path, capsys) -> None:
    (tmp_path / "ds").write_text("a file")
    assert main(["collect", "--dataset", str(tmp_path / "ds")]) == 2
    assert "The dataset cannot be written: File exists." in capsys.readouterr().err


def test_resume_needs_a_campaign(tmp_path, capsys) -> None:
    where = ["--dataset", str(tmp_path / "ds")]
    assert main(["collect", "--resume", *where]) == 2
    assert "no dataset" in capsys.readouterr().err
    Dataset.open(tmp_path / "ds").close()
    assert main(["collect", "--resume", *where]) == 2
    assert "has no campaign" in capsys.readouterr().err


def test_a_resumed_campaign_names_its_piece_where_the_lab_file_names_another(
    lab, tmp_path, capsys
) -> None:
    where = ["--dataset", str(tmp_path / "ds"), "--bench", str(lab), "--person", "ann"]
    Dataset.open(tmp_path / "ds").close()
    new_campaign("mushroom", "long", "random", 1, 20, None).save(tmp_path / "ds")
    main(["collect", "--resume", *where])
    assert "Resuming the campaign with its mushroom on long." in capsys.readouterr().out


@pytest.mark.skipif(sys.platform != "linux", reason="names of bytes")
@pytest.mark.parametrize("verb", ["export lerobot --video none --out", "train --out"])
def test_a_name_that_is_not_utf8_is_one_clear_error(verb, tmp_path, capsys) -> None:
    odd = tmp_path / "na\udcefve"
    with Dataset.open(odd, person="cleo") as dataset:
        fill(dataset, frames=False)
    place = ["--dataset", str(odd)] if verb.startswith("export") else [str(odd)]
    name, *words = verb.split()
    assert main([name, *words, str(tmp_path / "new\udcef.safetensors"), *place, "--json"]) == 2
    error = json.loads(capsys.readouterr().err.splitlines()[-1])["error"]
    assert error["what"] == "A name is not UTF-8."
    assert "\\udcef" in error["where"]


def test_names_and_intervals_of_a_table_stay_whole_on_80_columns(capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    screen = VerbOutput(json=False)
    texts = ("a value of some length", "standard uncertainty", "no, too uncertain for this")
    screen.table("names", ("parameter", "a", "b", "c"), ("spread.print_offset_mm", *texts))
    assert "spread.print_offset_mm" in capsys.readouterr().out


def test_coverage_is_drawn_with_y_up() -> None:
    seen = count_coverage([(0.0, 2.0)] * 3 + [(2.0, 0.0)] * 12, circle(8.0), circle(8.0))
    head, *rows = coverage_text(seen).splitlines()
    assert head.startswith("Covered 2 of ")
    upper = next(k for k, row in enumerate(rows) if "3" in row)
    lower = next(k for k, row in enumerate(rows) if "+" in row)
    assert lower == upper + 1
    assert rows[lower].index("+") > rows[upper].index("3")


@pytest.fixture
def data_set(tmp_path: Path) -> Path:
    data_set = tmp_path / "data"
    with Dataset.open(data_set) as dataset:
        context = context_for(dataset)
        for seed in range(3):
            dataset.record(small_episode(seed=seed), Label(seed, 0, 0, 1), source="commanded",
                           context=context)  # fmt: skip
    return data_set


def first_file(data_set: Path) -> Path:
    return sorted((data_set / "raw").rglob("*.mcap"))[0]


def flip_a_bit(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def test_status_counts_by_pair_and_state(data_set, say) -> None:
    code, answer = say("dataset", "--dataset", data_set)
    assert (code, answer["episodes"]) == (0, 3)
    assert answer["pairs"] == [
        {"piece": "pot", "bottom": "circle15", "state": "draft", "episodes": 3}
    ]
    assert answer["backup_age_h"] == 0.0
    (campaign,) = answer["campaigns"]
    assert (campaign["uuid"], campaign["episodes"], campaign["done"]) == ("campaign-1", 3, 1)


def test_status_names_the_writer_of_a_newer_schema_and_writes_nothing(data_set, say, capfd) -> None:
    assert say("dataset", "--dataset", data_set)[1]["newer_writer"] is None
    catalogue, description = data_set / "catalog.db", data_set / "dataset.json"
    with closing(sqlite3.connect(catalogue)) as connection:
        connection.execute("PRAGMA user_version = 99")
    facts = json.loads(description.read_text())
    for by, change in (
        ("a newer version (schema 99)", {}),
        ("touchdown 9.9 (schema 100)", {"schema_version": 100, "created_by": "touchdown 9.9"}),
    ):
        description.write_text(json.dumps(facts | change))
        before = catalogue.read_bytes(), description.read_bytes()
        assert say("dataset", "--dataset", data_set)[1]["newer_writer"] == by
        assert main(["dataset", "--dataset", str(data_set)]) == 0
        assert f"It was written by {by}." in capfd.readouterr().out
        assert (catalogue.read_bytes(), description.read_bytes()) == before


def test_the_usual_dataset_is_that_of_the_data_folder(data_set, say, monkeypatch) -> None:
    monkeypatch.setenv("TOUCHDOWN_DATA", str(data_set.parent))
    data_set.rename(data_set.parent / "dataset")
    assert say("dataset")[1]["episodes"] == 3
    assert say("doctor", "--dataset")[0] == 0


def test_doctor_reports_and_changes_nothing(data_set, say) -> None:
    before = say("doctor", "--dataset", data_set)
    assert before[0] == 0
    assert say("doctor", "--dataset", data_set) == before
    path = first_file(data_set)
    path.write_bytes(path.read_bytes()[:-50])
    for _ in range(2):
        code, answer = say("doctor", "--dataset", data_set)
        assert code == 1
        assert [f["kind"] for f in answer["findings"]] == ["torn"]
    assert path.exists()


def test_verify_reads_every_byte_and_notes_damage(data_set, say) -> None:
    assert say("dataset", "verify", "--dataset", data_set)[0] == 0
    path = first_file(data_set)
    flip_a_bit(path)
    code, answer = say("dataset", "verify", "--dataset", data_set)
    assert (code, [f["kind"] for f in answer["findings"]]) == (1, ["damaged"])
    assert say("dataset", "--dataset", data_set)[1]["files"] == {"complete": 2, "damaged": 1}


@pytest.mark.parametrize("damage", ["cut", "flipped", "removed"])
def test_a_loss_is_listed_by_every_verification_until_it_is_resolved(data_set, say, damage) -> None:
    path = first_file(data_set)
    whole = path.read_bytes()
    if damage == "flipped":
        flip_a_bit(path)
    elif damage == "cut":
        path.write_bytes(whole[:-50])
    else:
        path.unlink()
    for words in 3 * [("dataset", "verify")] + [("doctor",)]:
        code, answer = say(*words, "--dataset", data_set)
        assert code == 1
        assert [f["target"] for f in answer["findings"]] == [path.stem]
    path.write_bytes(whole)
    assert say("dataset", "verify", "--dataset", data_set)[0] == 0
    assert say("doctor", "--dataset", data_set)[0] == 0


def test_a_repaired_journal_is_listed_until_a_person_resolves_it(data_set, say) -> None:
    words = ("verify", "--resolve", "--person", "eve")
    journal = next((data_set / "labels").glob("*.jsonl"))
    flip_a_bit(journal)
    for command in 3 * [("dataset", "verify")] + [("doctor",)]:
        code, answer = say(*command, "--dataset", data_set)
        assert code == 1
        assert [(f["kind"], f["target"]) for f in answer["findings"]] == [
            ("journal-damaged", journal.stem)
        ]
    with Dataset.open(data_set) as dataset:
        assert "'touchdown dataset verify --resolve'" in dataset.notices[0]
        assert say("dataset", *words, "--dataset", data_set)[0] == 2  # another program writes
    code, answer = say("dataset", *words, "--dataset", data_set)
    assert (code, answer["findings"]) == (0, [])
    assert answer["resolved"] == [f"journal-damaged {journal.stem}"]
    assert say("dataset", "verify", "--dataset", data_set)[0] == 0
    assert say("doctor", "--dataset", data_set)[0] == 0


def test_doctor_names_a_damaged_catalogue(data_set, say) -> None:
    path = data_set / "catalog.db"
    whole = bytearray(path.read_bytes())
    at = whole.index(b"commanded") - 200
    whole[at : at + 300] = bytes(300)
    path.write_bytes(whole)
    for command in (("doctor",), ("dataset", "verify")):
        code, answer = say(*command, "--dataset", data_set)
        assert code in (1, 2)
        assert "dataset rebuild --replace" in str(answer)
    assert say("dataset", "rebuild", "--replace", "--dataset", data_set)[0] == 0
    assert say("doctor", "--dataset", data_set)[0] == 0


def test_verify_reports_progress_on_standard_error(data_set, capfd, monkeypatch) -> None:
    monkeypatch.setattr(dataset, "progress_lines", lambda: progress_lines(every_s=0.0))
    assert main(["dataset", "verify", "--dataset", str(data_set), "--json"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["findings"] == []
    assert "Episode files: 2 of 3 ..." in err


@pytest.mark.parametrize(
    ("module", "words"),
    [
        (dataset, ["collect", "--count", "0"]),
        (dataset, ["import", "csv", "rows.csv", "--person", "ann"]),
        (train, ["train", "DATASET", "--piece", "pot", "--out", "OUT", "--epochs", "1"]),
    ],
)
def test_an_opening_reports_its_progress_on_standard_error(
    data_set, capfd, monkeypatch, tmp_path, module, words
) -> None:
    monkeypatch.setattr(module, "progress_lines", lambda: progress_lines(every_s=0.0))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rows.csv").write_text("episode\n", "utf-8")
    with closing(sqlite3.connect(data_set / "catalog.db")) as connection, connection:
        connection.execute("DELETE FROM checked_folder")  # as after a crash
    names = {"DATASET": str(data_set), "OUT": str(tmp_path / "model.safetensors")}
    words = [names.get(word, word) for word in words]
    where = [] if words[0] == "train" else ["--dataset", str(data_set)]
    main([*words, *where, "--json"])
    assert "Episode files: 2 of 3 ..." in capfd.readouterr().err


def test_verify_looks_only_while_another_program_writes(data_set, say) -> None:
    path = first_file(data_set)
    with Dataset.open(data_set, person="ann") as dataset:
        code, answer = say("dataset", "verify", "--dataset", data_set)
        assert (code, answer["findings"], answer["noted"]) == (0, [], False)
        flip_a_bit(path)
        code, answer = say("dataset", "verify", "--dataset", data_set)
        assert (code, [f["kind"] for f in answer["findings"]]) == (1, ["damaged"])
        assert {e.file_state for e in dataset.episodes()} == {"complete"}
        dataset.labels.set("ann", dataset.episodes()[1].uuid, Label(9, 9, 0, 1))


def test_back_up_and_restore(data_set, say) -> None:
    code, answer = say("dataset", "backup", "--dataset", data_set)
    assert code == 0
    copy = Path(answer["backup"])
    assert copy == list_backups(data_set / "backup")[0].path
    kept = copy.read_bytes()
    with Dataset.open(data_set) as dataset:
        uuid = dataset.episodes()[0].uuid
        dataset.labels.set("ann", uuid, Label(77, 0, 0, 1))
    keep = data_set.parent / "keep.db"
    keep.write_bytes(kept)
    code, answer = say("dataset", "restore", str(keep), "--dataset", data_set)
    assert code == 0
    assert any("replayed" in notice for notice in answer["notices"])
    with Dataset.open(data_set) as dataset:
        assert dataset.labels.head(uuid).label.x_um == 77


@pytest.mark.parametrize("made", [True, False])
def test_a_dataset_without_labels_takes_those_of_any_backup(data_set, say, tmp_path, made) -> None:
    copy = say("dataset", "backup", "--dataset", data_set)[1]["backup"]
    new = tmp_path / "new"
    if made:
        Dataset.open(new).close()
    code, answer = say("dataset", "restore", copy, "--dataset", new)
    assert (code, answer["former"] is None) == (0, not made)
    assert "There were no labels here" in answer["notices"][-1]
    for part in ("raw", "geometry"):
        shutil.copytree(data_set / part, new / part, dirs_exist_ok=True)
    assert say("dataset", "verify", "--resolve", "--dataset", new)[0] == 0
    code, answer = say("dataset", "restore", copy, "--dataset", new)
    assert not any("There were no labels" in notice for notice in answer["notices"])
    assert say("dataset", "restore", "none.db", "--dataset", tmp_path / "typo")[0] == 2
    assert not (tmp_path / "typo").exists()


def test_rebuild_compares_and_replaces(data_set, say) -> None:
    code, answer = say("dataset", "rebuild", "--dataset", data_set)
    assert (code, answer["equal"], answer["replaced"]) == (0, True, False)
    assert answer["rows"]["episode"] == 3
    (data_set / "catalog.db").write_bytes(b"gone")
    code, answer = say("dataset", "rebuild", "--dataset", data_set)
    assert code == 2
    assert "--replace" in answer["error"]["fix"]
    code, answer = say("dataset", "rebuild", "--replace", "--dataset", data_set)
    assert (code, answer["replaced"]) == (0, True)
    assert say("dataset", "--dataset", data_set)[1]["episodes"] == 3


@pytest.mark.parametrize(
    "words",
    [["dataset", "restore"], ["dataset", "verify", "x.db"], ["dataset", "burn"],
     ["dataset", "restore", "none.db"], ["dataset", "merge"], ["dataset", "merge", "nowhere"]],
)  # fmt: skip
def test_bad_words_are_refused(data_set, say, words: list[str]) -> None:
    code, answer = say(*words, "--dataset", data_set)
    assert code == 2
    assert answer["error"]["fix"]


def test_no_dataset_says_so(tmp_path, say) -> None:
    for words in (["dataset"], ["dataset", "verify"], ["dataset", "rebuild"],
                  ["doctor", "--dataset", str(tmp_path)]):  # fmt: skip
        extra = [] if words[0] == "doctor" else ["--dataset", str(tmp_path)]
        code, answer = say(*words, *extra)
        assert code == 2, words
        assert str(tmp_path) in answer["error"]["where"]


FULL = Fault("DISK-FULL", "Only 0.42 GB are free.", "The run is paused.", "Make room.")


@pytest.mark.parametrize(
    ("typed", "json", "waits", "made", "left"),
    [
        ("\nnext", False, True, True, "next"),
        ("", False, True, False, ""),
        ("\nnext", True, True, False, "\nnext"),
        ("\nnext", False, False, False, "\nnext"),
    ],
)
def test_an_enter_goes_on_and_nobody_is_waited_for_in_vain(
    monkeypatch, typed, json, waits, made, left
) -> None:
    said = io.StringIO()
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))

    assert wait_for_disk_space(FULL, VerbOutput(json=json, stream=said), "run", waits=waits) is made
    assert sys.stdin.read() == left
    assert ("0.42 GB" in said.getvalue()) is not json
    assert ("press Enter" in said.getvalue()) is (waits and not json)


@pytest.mark.parametrize("verb", ["stack", "collect"])
@pytest.mark.parametrize(("typed", "confirmed"), [("\n", True), ("n\n", False), ("", False)])
def test_a_hand_over_is_confirmed_without_blocking_the_run(
    monkeypatch, verb, typed, confirmed
) -> None:
    answers, said = Queue(), io.StringIO()
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))
    session = SimpleNamespace(answer=answers.put)
    screen, event = VerbOutput(stream=said), HandOverAwaited(0.0, "pot", gives=True)
    if verb == "stack":
        answer_prompt(event, session, screen)
    else:
        RunProgress("Collecting", screen, ExitStack(), session).take(event)
    assert answers.get(timeout=5.0) is confirmed
    assert "pot" in said.getvalue()
    assert "Enter confirms." in said.getvalue()


@pytest.mark.parametrize(("typed", "confirmed"), [("y\n", True), ("\n", False), ("", False)])
def test_a_mounting_is_confirmed_by_y_alone_and_does_not_block_the_run(
    monkeypatch, typed, confirmed
) -> None:
    answers, said, may_read = Queue(), io.StringIO(), threading.Event()

    def read() -> str:
        assert may_read.wait(5.0)
        return typed

    monkeypatch.setattr("sys.stdin", SimpleNamespace(readline=read))
    session = SimpleNamespace(answer=answers.put)
    screen = VerbOutput(stream=said)
    RunProgress("Collecting", screen, ExitStack(), session).take(
        MountingAwaited(0.0, "circle15", 2)
    )
    assert answers.empty()
    may_read.set()
    assert answers.get(timeout=5.0) is confirmed
    assert "circle15" in said.getvalue()
