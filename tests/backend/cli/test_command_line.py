"""What an operator can get wrong is one clear error before any work or window."""

from __future__ import annotations

import argparse
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.backend.annotations.conftest import context_for, small_episode
from tests.backend.bench.brisk import CYCLE_US, RATE_HZ
from tests.backend.exchange.conftest import fill
from touchdown.backend.annotations import Dataset, Label
from touchdown.backend.bench import Session
from touchdown.backend.cli import command_line, simulate
from touchdown.backend.cli.command_line import VERBS, main
from touchdown.backend.cli.doctor import command
from touchdown.backend.cli.doctor.command import check_catalogue
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core import program_version
from touchdown.backend.core.events import CampaignBegan, ProbeCollected, RunStarted
from touchdown.backend.core.faults import (
    Fault,
    FaultError,
    InputError,
    RefusedError,
    StaleSampleError,
)
from touchdown.backend.episodes import find_packs, load_rows, read_episode, read_whole
from touchdown.backend.episodes.messages import stamps_ns
from touchdown.backend.experiments import collection, tables
from touchdown.backend.geometry import face_points, load_pieces, true_patch
from touchdown.backend.jobs import JobStore, SerialExecutor
from touchdown.backend.runs.event_log import EVENT_LOG_NAME, EventLog
from touchdown.backend.simulation.release_mujoco import mujoco_available


@pytest.mark.parametrize(
    "words",
    [
        ["train", "nowhere", "--out", "FILE/model"],
        ["experiment", "tables", "--out", "FILE"],
        ["simulate", "--episodes", "2", "--out", "FILE/data"],
        ["stack", "--runs", "FILE"],
    ],
)
def test_a_place_that_cannot_be_written_is_refused_first(words, tmp_path, capsys) -> None:
    (tmp_path / "file").write_text("in the way")
    words = [word.replace("FILE", str(tmp_path / "file")) for word in words]
    assert main([*words, "--json"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert json.loads(said.err)["error"]["where"].startswith(str(tmp_path / "file"))


def test_doctor_names_a_broken_piece_file(tmp_path) -> None:
    assert check_catalogue().ok
    (tmp_path / "mine.toml").write_text("title = 3\n")
    check = check_catalogue(tmp_path)
    assert not check.ok
    assert "mine.toml" in check.detail


def test_the_help_parts_every_verb_from_its_line(capsys) -> None:
    assert main([]) == 2
    said = capsys.readouterr().out
    for name, text in VERBS.items():
        assert f"  {name} " in said
        assert f" {text}\n" in said


def test_training_data_on_uneven_bottoms_need_the_wide_family(tmp_path, capsys) -> None:
    out = tmp_path / "out"
    data = ["experiment", "fused", "--parts", "0", "--surface-parts", "2", "--out", str(out)]
    assert main(data) == 2
    assert "with --outlines any" in capsys.readouterr().err
    assert main(["experiment", "beyond", "--strategies", "nope", "--out", str(out)]) == 2
    assert not out.exists(), "no empty folder is left"


def test_settings_that_are_no_text_name_no_line(tmp_path, capsys) -> None:
    (tmp_path / "bench.toml").write_bytes(b"\x00\xff\xfe")
    assert main(["stack", "--bench", str(tmp_path / "bench.toml")]) == 2
    said = capsys.readouterr().err
    assert "not text" in said
    assert "line" not in said


def test_garbage_is_no_journal(tmp_path, capsys) -> None:
    (tmp_path / "journal.jsonl").write_text("garbage\n")
    assert main(["replay", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "not a Touchdown event log" in said
    assert "before it" not in said
    for start in ("", '{"format":1,', '{"format":1,"program":"touchdown"}\n'):
        (tmp_path / "journal.jsonl").write_text(start)
        assert main(["replay", str(tmp_path)]) == 2
        assert "has no events" in capsys.readouterr().err


@pytest.fixture
def verb(monkeypatch):
    """Let the verb `stack` do what the test says."""

    def install(run, add_arguments=lambda parser: None):
        module = SimpleNamespace(run=run, add_arguments=add_arguments)
        monkeypatch.setattr(command_line.importlib, "import_module", lambda name: module)

    return install


def _raise(error):
    def run(args, screen):
        raise error

    return run


@pytest.mark.parametrize(
    "words", [*([name, "--help"] for name in VERBS), ["--help"], ["--version"]]
)
def test_help_and_version_are_no_errors(words, capsys):
    with pytest.raises(SystemExit) as left:
        main(words)
    assert left.value.code == 0
    said = capsys.readouterr().out
    assert "touchdown" in said
    assert len(words) == 1 or "--json" in said
    assert ("--reset-layout" in said) == (words[0] == "app"), "the window has its own arguments"


@pytest.mark.parametrize(
    "words",
    [
        *(["dataset", "merge"], ["dataset", "restore"], ["dataset", "verify", "x"]),
        *(["stak"], ["stack", "--no-such-thing"], ["stack", "--trials", "many"], ["--wrong"]),
        *(["app", "--theme", "foo"], ["app", "--them", "x"], ["app", "--size", "big"]),
    ],
)
def test_bad_words_are_bad_input(words, capsys):
    assert main(words) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert "fix:" in output.err
    assert words[0] != "app" or "See 'touchdown app --help'." in output.err
    assert words != ["stak"] or "Use one of: stack" in output.err, "the most similar comes first"


def test_bad_input_names_all_three_for_people_and_scripts(verb, capsys):
    error = {"what": "Broken.", "where": "pieces/pot.toml", "fix": "Mend it."}
    verb(_raise(InputError(**error)))
    assert main(["stack"]) == 2
    shown = capsys.readouterr().err
    assert all(word in shown for word in error.values())
    assert main(["stack", "--json"]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert json.loads(output.err) == {"error": error}


FAULT = Fault("CAMERA-STALE", "The left camera stopped.", "The run ended.", "Reconnect it.", "left")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (FaultError(FAULT), ("left camera stopped", "CAMERA-STALE", "Reconnect it.")),
        (RefusedError("unloaded", "The piece still presses."), ("still presses", "unloaded")),
        (StaleSampleError("wrench: no sample yet"), ("wrench: no sample yet",)),
    ],
)
@pytest.mark.parametrize("json_flag", [[], ["--json"]])
def test_a_run_that_failed_says_why(verb, capsys, error, words, json_flag):
    verb(_raise(error))
    assert main(["stack", *json_flag]) == 1
    output = capsys.readouterr()
    assert output.out == ""
    assert all(word in output.err for word in words)
    if json_flag:
        assert set(json.loads(output.err)["error"]) == {"what", "where", "fix"}


def test_an_interrupt_is_130(verb):
    verb(_raise(KeyboardInterrupt()))
    assert main(["stack"]) == 130


@pytest.mark.parametrize(("ends", "status"), [(1, 130), (RefusedError("A", "a"), 130), (0, 0)])
def test_a_run_that_ctrl_c_cancelled_is_130_unless_it_is_complete(verb, ends, status, capsys):
    cancelled = []

    def run(args, screen):
        with screen.ctrl_c_cancels(lambda: cancelled.append(True)):
            signal.raise_signal(signal.SIGINT)
        return _raise(ends)(args, screen) if isinstance(ends, Exception) else ends

    verb(run)
    assert main(["stack"]) == status
    assert cancelled == [True]


def test_a_word_too_long_for_a_file_is_one_error(verb, capsys):
    verb(_raise(InputError("No.", "here", "Change it.")))
    assert main(["stack", f"{'x' * 300}.toml"]) == 2
    assert capsys.readouterr().err.startswith("touchdown: ")


def test_a_defect_is_not_hidden(verb):
    verb(_raise(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        main(["stack"])


def test_an_error_of_a_file_names_it_and_another_one_is_a_defect(verb, capsys):
    verb(_raise(PermissionError(errno.EACCES, "Permission denied", "out/press.html")))
    assert main(["stack", "--json"]) == 2
    error = json.loads(capsys.readouterr().err)["error"]
    assert (error["what"], error["where"]) == ("Permission denied.", "out/press.html")
    verb(_raise(OSError("the socket is gone")))
    with pytest.raises(OSError, match="socket"):
        main(["stack"])


def test_a_verb_may_hand_unknown_words_on(verb):
    seen = []

    def run(args, screen):
        seen.append(args.handed_on)
        return 0

    verb(run, lambda parser: parser.set_defaults(handed_on=[]))
    assert main(["stack", "--theme", "dark"]) == 0
    assert seen == [["--theme", "dark"]]


def test_doctor_does_not_load_torch_or_qt():
    code = (
        "import sys; import touchdown.backend.cli.command_line; "
        "import touchdown.backend.cli.doctor.command; "
        "sys.exit(any(name in sys.modules for name in ('torch', 'PySide6', 'cv2')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.fixture
def copies(tmp_path: Path) -> tuple[Path, Path, str]:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    with Dataset.open(ours) as dataset:
        entry = dataset.record(
            small_episode(), Label(1, 2, 0, 3), source="commanded", context=context_for(dataset)
        )
    shutil.copytree(ours, theirs)
    return ours, theirs, entry.uuid


def label(folder: Path, person: str, uuid: str, x_um: int) -> None:
    with Dataset.open(folder) as dataset:
        dataset.labels.accept(person, uuid, Label(x_um, 0, 0, 50))


def test_merge_brings_labels_and_tells_conflicts(copies, capsys) -> None:
    ours, theirs, uuid = copies
    label(theirs, "bob", uuid, 500)
    words = ["dataset", "merge", str(theirs), "--dataset", str(ours), "--person", "ann", "--json"]
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["operations"], answer["episodes"], answer["conflicts"]) == (1, 0, [])
    with Dataset.open(ours) as dataset:
        dataset.labels.reject("ann", uuid, "tilt")
    with Dataset.open(theirs) as dataset:
        dataset.labels.undo("bob")
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["conflicts"] == [uuid]
    assert main(["dataset", "--dataset", str(ours), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["conflicts"] == 1
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["operations"] == 0
    assert main(["dataset", "merge", str(ours), "--dataset", str(ours)]) == 2
    assert "This is the dataset itself." in capsys.readouterr().err


@pytest.fixture
def exchange(tmp_path: Path) -> Path:
    with Dataset.open(tmp_path / "data", person="cleo") as dataset:
        fill(dataset, frames=False)
    return tmp_path / "data"


def test_out_and_in_again(exchange, say, tmp_path) -> None:
    out, back = tmp_path / "out", tmp_path / "back"
    code, answer = say("export", "lerobot", "--dataset", exchange, "--out", out, "--video", "none")
    assert (code, answer["episodes"]) == (0, 4)
    words = ("import", "lerobot", out, "--dataset", back, "--person", "dora")
    code, answer = say(*words, "--check")
    assert (code, answer["found"], answer["written"]) == (0, 4, 0)
    code, answer = say(*words)
    assert (code, answer["written"]) == (0, 4)
    code, answer = say(*words)
    assert (code, answer["here"], answer["written"]) == (0, 4, 0)
    with Dataset.open(back) as dataset:
        assert {dataset.labels.head(e.uuid).person for e in dataset.episodes()} == {"dora"}


def test_labels_go_out_and_come_in(exchange, say, tmp_path) -> None:
    for kind in ("csv", "coco"):
        out = tmp_path / kind
        assert say("export", kind, "--dataset", exchange, "--out", out)[0] == 0
        code, answer = say("import", kind, out, "--dataset", exchange, "--person", "ann")
        assert (code, answer["changed"], answer["unchanged"]) == (0, 0, 4)


def test_an_edited_table_without_its_manifest(exchange, say, tmp_path) -> None:
    say("export", "csv", "--dataset", exchange, "--out", tmp_path / "csv")
    table = tmp_path / "csv" / "episodes.csv"
    table.write_text(table.read_text().replace(",-2.501,", ",-2.600,"))
    words = ("--dataset", exchange, "--person", "ann")
    code, answer = say("import", "csv", tmp_path / "csv", *words)
    assert code == 2
    assert "missing or cut short" in str(answer) or "changed since" in str(answer)
    code, answer = say("import", "csv", table, *words)
    assert (code, answer["changed"]) == (0, 1)
    assert Path(answer["backup"]).parent == exchange / "backup"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("export", "csv", "--out", "{tmp}/o", "--states", "perfect"), "--states"),
        (("export", "csv", "--out", "{tmp}/o", "--held-out", "1"), "--held-out"),
        (("export", "csv", "--out", "{tmp}/o", "--seed", "-1"), "--seed"),
        (("export", "csv", "--out", "{tmp}/o", "--piece", "barrel"), "barrel"),
        (("export", "csv", "--out", "{tmp}/o", "--video", "all"), "--video"),
        (("export", "gif", "--out", "{tmp}/o"), "export"),
        (("import", "csv", "{tmp}/none.csv", "--person", "ann"), "none.csv"),
        (("import", "csv", "{tmp}"), "--person"),
        (("dataset", "verify", "--replace"), "--replace"),
        (("import", "lerobot", "{tmp}", "--person", "ann"), "{tmp}"),
    ],
)
def test_bad_wishes_are_refused(words, why, exchange, say, tmp_path) -> None:
    called = [word.format(tmp=tmp_path) for word in words]
    code, answer = say(*called, "--dataset", exchange)
    assert code == 2
    assert why.format(tmp=tmp_path) in answer["error"]["where"]
    assert answer["error"]["fix"]


def test_two_shards_make_one_experiment(tmp_path, capsys, monkeypatch) -> None:
    small = replace(tables.QUICK, groups=4, trials=2)
    monkeypatch.setitem(tables.SCALES, "quick", small)
    words = ["experiment", "tables", "--pieces", "pot", "--executor", "serial", "--json"]
    words += ["--preset", "quiet"]  # bottoms that stand still cost the least
    words += ["--out", str(tmp_path)]
    missing = []
    for shard in ("0/2", "1/2"):
        assert main([*words, "--shard", shard]) == 0
        missing.append(json.loads(capsys.readouterr().out)["missing"])
    assert missing[0] > 0
    assert missing[1] == 0
    folders = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["failed"] == []
    assert Path(answer["page"]).is_file()
    assert folders == {p.name: p.stat().st_mtime_ns for p in (tmp_path / "jobs").iterdir()}
    assert answer["tables"]["table3"][1]["cells"][0]["n"] == 2


SMALL = ["simulate", "--piece", "pot", "--bottoms", "circle15,square15", "--episodes", "6"]
SMALL += ["--probes-per-grip", "3", "--grips-per-mounting", "2", "--seed", "4", "--json"]
START = ["--start", "2026-01-31T12:00:00+01:00"]
START_NS = 1_769_857_200_000_000_000


def test_packs_are_stamped_with_the_start_and_their_headers_with_the_bench_clock(
    tmp_path, capsys
) -> None:
    small = ["simulate", "--bottoms", "circle15", "--episodes", "2", "--probes-per-grip", "1"]
    spans, episodes = [], []
    for name, start in (("now", []), ("then", START)):
        assert main([*small, "--json", *start, "--out", str(tmp_path / name / "packs")]) == 0
        (path,) = find_packs(tmp_path / name)
        with path.open("rb") as file:
            spans.append([message.log_time for *_, message in make_reader(file).iter_messages()])
        whole = read_whole(path)
        assert whole.metadata["pack"]["clock_start_ns"] == str(min(spans[-1]))
        assert stamps_ns(whole.messages["/obs"])[0] == 100_000_000
        with Dataset.open(tmp_path / name) as dataset:
            episodes.append({entry.uuid for entry in dataset})
    capsys.readouterr()
    assert abs(min(spans[0]) - time.time_ns()) < 600e9
    assert (min(spans[1]), max(spans[1])) == (START_NS, START_NS + 5_000_000_000)
    # Equal content has the same ids whenever it was simulated.
    assert len(episodes[0]) == 2
    assert episodes[0] == episodes[1]
    for wrong in ("yesterday", "1969-12-31", "2200-01-01"):
        assert main([*small, "--start", wrong, "--out", str(tmp_path / "no")]) == 2
        assert "--start" in capsys.readouterr().err
    assert main([*small, "--bottoms", "circle15, circle15", "--out", str(tmp_path / "no")]) == 2
    assert "each bottom once, and at least one" in capsys.readouterr().err


def test_simulated_packs_are_complete_and_the_same_for_any_number_of_workers(
    tmp_path, capsys
) -> None:
    out, other = tmp_path / "data", tmp_path / "other"
    assert main([*SMALL, *START, "--workers", "1", "--out", str(out)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["episodes"], answer["out"]) == (12, str(out))
    assert answer["seconds"] > 0
    rows = load_rows(out)
    assert (len(rows), rows.piece) == (12, "pot")
    assert sorted(set(rows.bottom)) == ["circle15", "square15"]
    assert len(set(rows.grip_id)) == 4
    assert len(set(rows.mounting_id)) == 2
    label = rows.labels[0]
    assert (label["person"], label["source"]) == ("simulation", "commanded")
    assert (label["sigma_um"], label["points"]) == (512, 177)
    assert len({label["episode"] for label in rows.labels}) == 12

    catalogue = load_pieces()
    points = face_points(catalogue.top("pot").face)
    for k, name in enumerate(rows.bottom):
        patch = true_patch(points, rows.offset_mm[k], catalogue.bottom(name).upper)
        # The label is rounded to whole micrometres: a point on the edge may change sides.
        assert np.count_nonzero(patch != rows.patch[k]) <= 1
    metadata = read_whole(find_packs(out)[0]).metadata["pack"]
    assert metadata["simulated"] == "true"
    assert json.loads(metadata["settings"])["preset"] == "mixed"
    assert metadata["probes_per_grip"] == "3"
    assert main([*SMALL, *START, "--workers", "2", "--out", str(other)]) == 0
    for first, second in zip(find_packs(out), find_packs(other), strict=True):
        assert first.name == second.name
        assert first.read_bytes() == second.read_bytes()
    assert main([*SMALL, "--out", str(out)]) == 2, "a folder with episodes takes no others"
    assert [p.read_bytes() for p in find_packs(out)] == [p.read_bytes() for p in find_packs(other)]


def test_shards_of_a_simulation_make_one_folder_and_continue_after_an_interruption(
    tmp_path, capsys
) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main([*SMALL, *START, "--executor", "serial", "--out", str(whole)]) == 0
    shared = [*SMALL, *START, "--executor", "serial", "--out", str(parts)]
    missing, packs = [], []
    for shard in ("0/2", "0/2", "1/2"):
        capsys.readouterr()
        assert main([*shared, "--shard", shard]) == 0
        missing.append(json.loads(capsys.readouterr().out)["missing"])
        packs.append(len(find_packs(parts)))
    assert missing[0] == missing[1] == 2 - packs[0]
    assert (missing[2], packs[2]) == (0, 2)
    for first, second in zip(find_packs(whole), find_packs(parts), strict=True):
        assert (first.name, first.read_bytes()) == (second.name, second.read_bytes())
    # Killed after its job was finished, before its pack was moved.
    pack = find_packs(parts)[0]
    specs = {path: path.read_text("utf-8") for path in parts.glob(".jobs/*/spec.json")}
    (spec,) = [path for path, text in specs.items() if "circle15" in text]
    pack.rename(spec.with_name(pack.name))
    assert len(find_packs(parts)) == 1, "packs of hidden folders are not read"
    assert main(shared) == 0
    assert len(find_packs(parts)) == 2
    for other in (["--seed", "5"], ["--start", "2026-01-31T12:00:01+01:00"]):
        assert main([*shared, *other]) == 2, "another collection"
    assert main([*SMALL, "--shard", "0/2", "--out", str(tmp_path / "new")]) == 2
    assert "--start" in capsys.readouterr().err


def test_jobs_without_a_result_in_the_shared_folder_have_failed(tmp_path, capsys, monkeypatch):
    def elsewhere(args, kinds, store, tell):
        return SerialExecutor(kinds, JobStore(tmp_path / "elsewhere"))

    monkeypatch.setattr("touchdown.backend.cli.experiment.executors._executor", elsewhere)
    assert main([*SMALL, *START, "--out", str(tmp_path / "out")]) == 1
    assert len(json.loads(capsys.readouterr().out)["failed"]) == 2


def test_nested_and_foreign_annotations_are_refused_in_plain_words(tmp_path, capsys) -> None:
    Dataset.open(tmp_path / "data").close()
    for content, why in (
        (b"[" * 100 + b"]" * 100, "deeper than 64"),
        (b"\xff", "UTF-8"),
        (b"{}", "'info' is"),
    ):
        (tmp_path / "a.json").write_bytes(content)
        words = ["import", "coco", str(tmp_path / "a.json"), "--person", "ann"]
        assert main([*words, "--dataset", str(tmp_path / "data")]) == 2
        said = capsys.readouterr().err
        assert why in said
        assert "Error(" not in said


def test_jobs_cover_every_grip_once() -> None:
    from tests.backend.simulation.test_batch import plan

    for probes_per_grip in (1, 7, 50):
        made = plan(episodes=1234, probes_per_grip=probes_per_grip)
        jobs = collection.split_jobs(made, {}, None)
        grips = [grip for job in jobs for grip in job.grips]
        assert grips == list(range(made.grips))
        assert sum(job.episodes for job in jobs) == 1234


def test_a_large_plan_has_wide_jobs_and_a_small_one_jobs_for_all_workers() -> None:
    from tests.backend.simulation.test_batch import plan

    for episodes, widest in ((2_000, 20), (6_000, 30), (100_000, 100)):
        jobs = collection.split_jobs(plan(episodes=episodes, probes_per_grip=50), {}, None)
        assert max(len(job.grips) for job in jobs) == widest


def test_only_the_last_plan_of_a_call_has_small_jobs(tmp_path: Path) -> None:
    words = ["--episodes", "2000", "--out", str(tmp_path)]
    parser = argparse.ArgumentParser()
    simulate.add_arguments(parser)
    jobs = simulate._jobs(parser.parse_args(words), 0)
    sizes = [(job.params["bottom"], job.params["probes"]) for job in jobs]
    assert sizes == [
        ("circle15", 2000), ("circle25", 2000), ("square15", 1000), ("square15", 1000)
    ]  # fmt: skip


TRIAL_KEYS = {"seed", "outcome", "reason", "probes", "excess_probes", "margin_mm", "contradicted"}
OUTCOMES = {"placed", "fell", "knocked_over", "gave_up", "asked", "aborted"}


@pytest.fixture
def bench(tmp_path: Path) -> str:
    """Settings of a bench with half the pictures."""
    path = tmp_path / "bench.toml"
    path.write_text(f"cycle_us = {CYCLE_US}\n[tactile]\nrate_hz = {RATE_HZ}\n", "utf-8")
    return str(path)


def call(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    status = main([*words, "--json"])
    told = capsys.readouterr()
    return status, told.out, told.err


def struck(runs, bench, at, sign):
    """Send ``sign`` to a long run when it prints ``at``; return its exit code and output since."""
    command = [sys.executable, "-m", "touchdown", "stack", "--trials", "50", "--runs", str(runs)]
    command += ["--bench", bench]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ) as child:
        next(line for line in child.stdout if at in line)
        child.send_signal(sign)
        rest = child.stdout.read().decode()
        return child.wait(60), rest


def test_stack_then_replay_tell_the_same(tmp_path, bench, capsys) -> None:
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


def test_the_shipped_model_is_the_one_recorded(tmp_path, capsys) -> None:
    runs = tmp_path / "runs"
    call(capsys, "stack", "--inject", "tactile_left:stop@0.5", "--runs", str(runs))
    head = (next(runs.glob("*")) / EVENT_LOG_NAME).read_text("utf-8").splitlines()[1]
    settings = json.loads(json.loads(head)["settings"])
    assert set(settings) == {
        "request", "method", "simulation", "disturbances", "model", "program", "limits",
    }  # fmt: skip
    assert settings["disturbances"] == ["tactile_left:stop@0.5"]
    assert len(settings["model"]["weights_sha256"]) == 64
    assert settings["program"] == program_version()


@pytest.mark.parametrize(
    ("verb", "words", "where"),
    [
        ("stack", "--piece nope", "nope"),
        ("stack", "--piece short", "short"),
        ("stack", "--bottom nope", "nope"),
        ("stack", "--bottom=", "--bottom"),
        ("stack", "--bottom pot+short", ""),
        ("stack", "--model no/such/file.safetensors", "no/such/file.safetensors"),
        ("stack", "--bench no/such/file.toml", "no/such/file.toml"),
        ("stack", "--preset easy", "preset"),
        ("stack", "--inject camera", "camera"),
        ("stack", "--trials 0", "--trials"),
        ("stack", "--seed -1", "--seed"),
        ("stack", "--pieces no/such/folder", "no/such/folder"),
        ("simulate", "--piece teapot", "teapot"),
        ("simulate", "--bottoms circle15,moon", "moon"),
        ("simulate", "--bottoms circle15,circle15", "--bottoms"),
        ("simulate", "--episodes 0", "--episodes"),
        ("simulate", "--seed -1", "--seed"),
        ("simulate", "--preset loud", "preset"),
        ("simulate", "--bench nowhere.toml", "nowhere.toml"),
        ("models", "--test-episodes 0", "--test-episodes"),
        ("models", "--epochs 0", "--epochs"),
        ("models", "--pieces=", "resources/objects"),
        ("experiment", "tables --workers 0", "--workers"),
        ("experiment", "tables --pieces teapot", "--pieces"),
        ("experiment", "tables --pieces=", "--pieces"),
        ("experiment", "tables --full --models .", "--models"),
        ("experiment", "tables --executor dask", "--cluster"),
        ("experiment", "tables --shard 2/2", "--shard"),
        ("experiment", "tables --preset loud", "--preset"),
        ("experiment", "tables --bench nowhere.toml", "nowhere.toml"),
        ("experiment", "tables --full --quick", "touchdown experiment"),
    ],
)
def test_bad_input_is_one_error_and_leaves_nothing_behind(verb, words, where, tmp_path, capsys):
    out = tmp_path / "out"
    folder = "--runs" if verb == "stack" else "--out"
    status, told, err = call(capsys, verb, *words.split(), folder, str(out))
    assert (status, told) == (2, "")
    error = json.loads(err)["error"]
    assert set(error) == {"what", "where", "fix"}
    assert where in error["where"]
    assert all(error.values())
    assert verb == "experiment" or not out.exists()


def test_a_run_killed_in_the_middle_replays_to_its_last_fact(tmp_path, bench, capsys) -> None:
    runs = tmp_path / "runs"
    struck(runs, bench, b"Probe 2", signal.SIGKILL)
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


def test_ctrl_c_before_a_run_has_begun_interrupts() -> None:
    screen = VerbOutput()
    with pytest.raises(KeyboardInterrupt), screen.ctrl_c_cancels(lambda: False):
        signal.raise_signal(signal.SIGINT)
    with screen.ctrl_c_cancels(lambda: True):
        signal.raise_signal(signal.SIGINT)


def test_ctrl_c_lifts_tells_the_result_and_closes_the_journal(tmp_path, bench, capsys) -> None:
    runs = tmp_path / "runs"
    status, rest = struck(runs, bench, b"Probe 1", signal.SIGINT)
    assert status == 130
    assert "aborted" in rest
    assert "Kept in" in rest
    told = json.loads(call(capsys, "replay", "latest", "--runs", str(runs))[1])
    assert told["ending"] == "cancelled"
    assert told["trials"][-1]["outcome"] == "aborted"


def test_a_run_calls_a_person_by_a_command(tmp_path, capsys) -> None:
    called = tmp_path / "called"
    path = tmp_path / "call.sh"
    path.write_text(f'#!/bin/sh\necho "$1: $2" >> {called}\n')
    path.chmod(0o755)
    words = ("stack", "--strategy", "pick-and-place", "--runs", str(tmp_path / "runs"))
    assert call(capsys, *words, "--notify", str(path))[0] == 1
    assert called.read_text().startswith("Touchdown: end: The run ended (finished)")
    status, _, err = call(capsys, *words, "--notify", "no-such-program-at-all")
    assert status == 2
    assert "There is no program 'no-such-program-at-all'" in err


def own_piece(tmp_path, shipped, name):
    """Return a folder with a shipped piece under another name."""
    (tmp_path / "pieces").mkdir()
    text = files("touchdown.resources").joinpath("objects", f"{shipped}.toml").read_text("utf-8")
    (tmp_path / "pieces" / f"{name}.toml").write_text(text, "utf-8")
    return tmp_path / "pieces"


def test_an_operators_own_piece_can_be_stacked_upon(tmp_path, capsys) -> None:
    folder = own_piece(tmp_path, "short", "mystub")
    words = ("--pieces", str(folder), "--bottom", "mystub", "--strategy", "pick-and-place")
    status, out, _ = call(capsys, "stack", *words, "--runs", str(tmp_path / "runs"))
    assert status == 1
    assert json.loads(out)["trials"][0]["outcome"] == "fell"


def test_pick_and_place_asks_for_no_model(tmp_path, capsys) -> None:
    pieces = own_piece(tmp_path, "pot", "own")
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


def test_a_camera_that_falls_silent_ends_in_one_fault_and_keeps_the_rest(tmp_path, capsys) -> None:
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


@pytest.mark.promise("S12")
def test_the_end_of_a_run_names_the_devices_whose_faults_come_later(
    tmp_path, bench, capsys, monkeypatch
) -> None:
    """The fault of the arm comes before any other device is late."""
    lost = Fault("MXT-LOST", "No reply.", "It stands.", "Press Reset.", "arm")
    advance = Session.advance

    def lose_arm(session: Session) -> None:
        advance(session)
        if session.clock_s() > 2.99:
            session.interlock.raise_fault(lost)

    monkeypatch.setattr(Session, "advance", lose_arm)
    words = ["stack", "--strategy", "pick-and-place", "--runs", str(tmp_path), "--bench", bench]
    for device in ("force_torque", "tactile_left", "tactile_right"):
        words += ["--inject", f"{device}:stop@3.0"]
    others = " Also with a fault: left tactile camera, right tactile camera, wrist sensor."
    (trial,) = json.loads(call(capsys, *words)[1])["trials"]
    assert trial["reason"] == f"No reply. It stands. Start again. [MXT-LOST]{others}"
    assert main(words) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert said.count(others) == 1


def test_a_camera_silent_for_a_moment_costs_one_probe(tmp_path, bench, capsys) -> None:
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


def test_a_run_of_a_removed_strategy_still_replays(tmp_path, capsys) -> None:
    folder = tmp_path / "run"
    journal = EventLog(folder)
    journal(RunStarted(0.0, "stack", "pot", "short", "pressure", 7, 1, True, "{}"))
    assert main(["replay", str(folder), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["piece"], result["facts"]) == ("pot", {"RunStarted": 1})


def test_a_collection_replays_as_its_probes(tmp_path, capsys) -> None:
    folder = tmp_path / "20260101-run"
    journal = EventLog(folder)
    journal(RunStarted(0.0, "run", "pot", "short", "", 7, 2, True, "{}", activity="collect"))
    journal(CampaignBegan(0.0, "campaign-1", "series-1", "data/pot", 0, 2))
    signals = (0.0,) * 5
    for item, reasons in ((4, ""), (7, "slip in grasp")):
        place = (item, 1, 1 + item // 5, 2, (1.5, -2.0), (1.45, -1.98), 0.12)
        journal(ProbeCollected(1.0, f"uuid-{item}", *place, signals, 0.0, 0.0, reasons))
    assert main(["replay", "latest", "--runs", str(tmp_path)]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "Collection: 2 probes, 2 of 2 of campaign campaign-1, in data/pot" in words
    assert "+1.50, -2.00" in words
    assert "slip in grasp" in words
    assert "placed" not in words
    assert main(["replay", "latest", "--runs", str(tmp_path), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["activity"], [p["item"] for p in answer["probes"]]) == ("collect", [4, 7])


@pytest.mark.parametrize(
    ("words", "where", "what"),
    [
        ("import mcap {own} --map {new} --preview {own}", "own.mcap", "another kind"),
        ("track {own} --overlay {own}", "own.mcap", "another kind"),
        ("track {own} --overlay {film}", "own.mcap", "neither a picture nor"),
        ("track {film} --overlay {film}", "film.mp4", "would replace"),
        ("train {tmp} --out {own}", "own.mcap", "another kind"),
        ("train {new}", "new", "is no such folder"),
        ("identify {tmp} --out {lab}", "lab.toml", "would be replaced"),
        ("identify {tmp} --out {method}", "method.toml", "would be replaced"),
        ("identify {tmp} --bench {bench} --out {bench}", "bench.toml", "would replace"),
        ("doctor --dataset {tmp} --bench {bench}", "--bench, --dataset", "separate"),
        ("doctor --bundle {own}", "own.mcap", "exists already"),
        ("doctor --with-names", "--with-pictures, --with-names", "problem report"),
        ("models --seed -1 --out {new}", "--seed", "at least 0"),
    ],
)
def test_an_output_replaces_no_input_and_no_file_of_another_kind(
    words, where, what, tmp_path, capsys, monkeypatch
):
    files = {"own": "own.mcap", "film": "film.mp4"}
    files |= {name: f"{name}.toml" for name in ("lab", "bench", "method")}
    paths = {name: tmp_path / file for name, file in files.items()}
    for name, path in paths.items():
        path.write_text({"lab": "kind = 'hardware'", "method": "[fused]"}.get(name, ""), "utf-8")
    monkeypatch.setattr(command, "EXAMINATIONS", (lambda: pytest.fail("examined first"),))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert main([*words.format(tmp=tmp_path, new=tmp_path / "new", **paths).split(), "--json"]) == 2
    error = json.loads(capsys.readouterr().err)["error"]
    assert error["where"].endswith(where)
    assert what in error["what"]
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


INTERRUPTING = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[-1]:
            os.kill(os.getpid(), signal.SIGINT)

# A job in the background of a shell inherits an ignored SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupt())
from touchdown.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("importlib.metadata", ""),
        ("touchdown.backend.cli.command_line", ""),
        ("touchdown.backend.config", ""),
        ("touchdown.backend.cli.doctor.command", "Interrupted.\n"),
    ],
)
def test_ctrl_c_during_the_imports_prints_no_traceback(module, said) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTING, "doctor", module],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (130, "", said)


def test_the_installed_program_is_the_one_that_ctrl_c_ends_silently() -> None:
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text("utf-8"))
    assert project["project"]["scripts"]["touchdown"] == "touchdown.__main__:main"


@pytest.mark.parametrize("bounds", ["[NaN, 8.0]", "[8.0, 2.0]", "[0.0, Infinity]"])
def test_ranges_that_cannot_be_drawn_from_are_one_error(bounds, tmp_path, capsys) -> None:
    ranges = tmp_path / "ranges.json"
    ranges.write_text(f'{{"randomisation": {{"grasp.shear_n_mm": {bounds}}}}}', "utf-8")
    for verb in (["experiment", "fused"], ["simulate"]):
        assert main([*verb, "--ranges", str(ranges), "--out", str(tmp_path / "out")]) == 2
        assert "This file has no ranges." in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
