"""Certification: fresh scenes of an attempt, trials of a laboratory, commands and files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.backend.cli import main
from touchdown.backend.config import BenchIdentity, StackSettings, load_lab, load_simulation
from touchdown.backend.core import (
    Event,
    InputError,
    Outcome,
    PhaseEntered,
    RunStarted,
    TrialFinished,
    TrialStarted,
    program_version,
)
from touchdown.backend.experiments.certification import (
    FAMILIES,
    Certification,
    certify_laboratory,
    fresh_scene,
    labelled_trials,
    run_certified_scenes,
)
from touchdown.backend.experiments.job_kinds import KINDS
from touchdown.backend.experiments.tables import PIECES
from touchdown.backend.geometry import load_pieces
from touchdown.backend.jobs import JobContext, JobSpec, JobStore
from touchdown.backend.learning.fused import (
    AttemptLog,
    attempts_path,
    method_sha256,
    risk_bound,
    shipped_fused,
)
from touchdown.backend.learning.fused.certificate import read_certificate
from touchdown.backend.learning.fused.checkpoint import shipped_path
from touchdown.backend.runs import StackRequest, certificate_status
from touchdown.backend.runs.event_log import EVENT_LOG_NAME, FORMAT, encode_event
from touchdown.backend.simulation import true_margin_mm

BENCH = load_simulation(preset="bench-v1")


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """A copy of the network that ships, in a folder that can be written."""
    folder = tmp_path / "model"
    folder.mkdir()
    for path in (shipped_path(), shipped_path().with_suffix(".json")):
        shutil.copy(path, folder)
    return folder / shipped_path().name


def test_every_scene_has_a_seed_of_its_own_and_a_third_has_each_piece(weights: Path) -> None:
    plan = Certification(BENCH, "bench-v1", weights, (0.03, 0.07), 300)
    attempt = plan.begin(AttemptLog(attempts_path(weights)))
    jobs = plan.jobs(attempt)
    seeds = [s for job in jobs for s in range(job.seed, job.seed + job.params["trials"])]
    assert sorted(seeds) == list(attempt.seeds())
    for risk in plan.risks:
        own = [job.params for job in jobs if job.params["method"]["fused"]["risk"] == risk]
        scenes = {p: sum(o["trials"] for o in own if o["piece"] == p) for p in PIECES}
        assert scenes == dict.fromkeys(PIECES, 100)
    assert attempt.error == 0.0125  # two risks share the error of the first attempt
    assert attempt.program_version == program_version()


@pytest.mark.parametrize("family", FAMILIES)
def test_a_seed_decides_its_scene_and_no_two_share_an_outline(family: str) -> None:
    piece = load_pieces().top("pot")
    scenes = [fresh_scene(piece, seed, BENCH, family) for seed in (5, 5, 6, 7)]
    faces = [scene.surface.path() for scene in scenes]
    assert scenes[0].start_mm == scenes[1].start_mm
    assert np.array_equal(faces[0], faces[1], equal_nan=True)
    assert len({scene.start_mm for scene in scenes}) == 3
    assert all(true_margin_mm(scene, scene.start_mm, 0.0) < 0.0 for scene in scenes)


def test_scenes_run_with_the_network_of_the_attempt(weights: Path, tmp_path: Path) -> None:
    plan = Certification(BENCH, "bench-v1", weights, (0.07,), 1)
    job = plan.jobs(plan.begin(AttemptLog(attempts_path(weights))))[0]
    store = JobStore(tmp_path / "jobs")
    found = run_certified_scenes(job, JobContext(tmp_path, store))
    assert [t["seed"] for t in found["trials"]] == [job.seed]
    assert all(t["released"] for t in found["trials"] if t["outcome"] in ("placed", "fell"))


def certify(folder: Path, weights: Path, *more: str) -> int:
    return main([
        "experiment", "certify", "--model", str(weights), "--preset", "bench-v1",
        "--level", "0.05", "--executor", "serial", "--out", str(folder), "--json", *more,
    ])  # fmt: skip


def pretend(unsafe_share: float) -> Any:
    """Return a job that ends that share of its scenes unsafe."""

    def run(spec: JobSpec, _: JobContext) -> dict[str, Any]:
        n = spec.params["trials"]
        fell = round(unsafe_share * n)
        words = (
            ["fell", "knocked_over"] * (fell // 2)
            + ["fell"] * (fell % 2)
            + ["gave_up"] * 4
            + ["placed"] * (n - fell - 4)
        )
        rows = [
            {"seed": spec.seed + k, "outcome": word, "released": word != "gave_up"}
            for k, word in enumerate(words)
        ]
        return {"trials": rows}

    return run


def test_command_writes_a_certificate_and_logs_each_attempt(
    weights: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(KINDS, "certify", pretend(0.02))
    assert certify(tmp_path / "out", weights) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["certificate"] is None
    assert not list(weights.parent.glob("*.certificate.json"))
    monkeypatch.setitem(KINDS, "certify", pretend(0.0))
    assert certify(tmp_path / "out", weights) == 0
    second = json.loads(capsys.readouterr().out)
    found = read_certificate(Path(second["certificate"]))
    assert Path(second["certificate"]).parent == weights.parent
    assert found.summary() == "unsafe ≤ 0.2 % of releases (95 %), 0 of 2,760 on bench-v1"
    attempts = AttemptLog(attempts_path(weights)).attempts()
    assert [(a.number, a.state, a.counts[0].unsafe) for a in attempts] == [
        (1, "ended", 60),
        (2, "ended", 0),
    ]
    assert not set(attempts[0].seeds()) & set(attempts[1].seeds())


def test_interrupted_attempt_is_continued_with_the_same_seeds(
    weights: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(spec: JobSpec, place: JobContext) -> dict[str, Any]:
        if spec.params["piece"] == "pot":
            raise MemoryError
        result: dict[str, Any] = pretend(0.0)(spec, place)
        return result

    monkeypatch.setitem(KINDS, "certify", broken)
    assert certify(tmp_path / "out", weights) == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["missing"], told["attempt"]["counts"]) == (20, [])
    monkeypatch.setitem(KINDS, "certify", pretend(0.0))
    assert certify(tmp_path / "out", weights) == 0
    (attempt,) = AttemptLog(attempts_path(weights)).attempts()
    assert (attempt.number, attempt.seed, attempt.state) == (1, told["attempt"]["seed"], "ended")


@pytest.mark.parametrize(
    ("more", "where"),
    [
        (["--level", ""], "--level"),
        (["--level", "0.05,0.05"], "--level"),
        (["--level", "1.5"], "--level"),
        (["--scenes", "2999"], "--scenes"),
    ],
)
def test_refused_attempts_are_not_spent(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], where: str
) -> None:
    assert certify(tmp_path / "out", weights, *more) == 2
    assert where in capsys.readouterr().err
    assert not attempts_path(weights).exists()


METHOD = StackSettings(strategy="fused")
LAB = "c" * 64
End = Outcome | None  # None: the run ended between release and answer


def release_of(**changed: object) -> dict[str, object]:
    return {
        "bench": "lab 3", "bench_sha256": LAB, "method_sha256": method_sha256(METHOD),
        "weights_sha256": shipped_fused().card.weights_sha256, "risk": METHOD.fused.risk,
        "weighed": False, **changed,
    }  # fmt: skip


def record_run(
    folder: Path, name: str, ends: Sequence[End], *, simulated: bool = False, **changed: object
) -> None:
    """Write the log of a run whose trials end that way; a trial that gave up released nothing."""
    settings = json.dumps({"release": release_of(**changed)})
    events: list[Event] = [
        RunStarted(0.0, name, "pot", "short", "fused", 1, len(ends), simulated, settings)
    ]
    for trial, end in enumerate(ends, start=1):
        events.append(TrialStarted(0.0, trial, trial, None))
        if end is not Outcome.GAVE_UP:
            events.append(PhaseEntered(1.0, "release", 2))
        if end is not None:
            events.append(TrialFinished(2.0, trial, trial, end, "", 2, None, None))
    lines = [{"format": FORMAT, "program": "touchdown"}, *map(encode_event, events)]
    (folder / name).mkdir(parents=True)
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (folder / name / EVENT_LOG_NAME).write_text(text)


def lab_bench(folder: Path, sha256: str = LAB) -> BenchIdentity:
    return BenchIdentity("lab 3", sha256, folder / "calibrations")


def test_certificate_of_a_laboratory_comes_from_its_labelled_releases(tmp_path: Path) -> None:
    runs, bench = tmp_path / "runs", lab_bench(tmp_path)
    ends: list[End] = [Outcome.PLACED] * 149 + [Outcome.FELL, Outcome.GAVE_UP]
    record_run(runs, "1", ends)
    record_run(runs, "2", [Outcome.FELL] * 9, simulated=True)
    record_run(runs, "3", [Outcome.FELL] * 9, bench_sha256="")
    found = certify_laboratory(list(labelled_trials(runs)), bench)
    (counts,) = found.attempt.counts
    assert (counts.scenes, counts.releases, counts.unsafe) == (151, 150, 1)
    assert counts.bound == risk_bound(1, 150, 0.025)
    assert found.path is not None
    assert found.certificate == read_certificate(found.path)
    status = certificate_status(bench, METHOD, StackRequest(strategy="fused"))
    assert status.text == "unsafe ≤ 3.7 % of releases (95 %), 1 of 150 on lab 3"
    other = certificate_status(bench, METHOD, StackRequest(strategy="fused", bottoms=("long",)))
    assert other.message == ("No certificate for this bench: it does not cover the bottom 'long'.")


def test_void_and_unanswered_releases_count_as_unsafe(tmp_path: Path) -> None:
    record_run(tmp_path, "1", [Outcome.PLACED, Outcome.ABORTED, Outcome.GAVE_UP])
    record_run(tmp_path, "2", [Outcome.KNOCKED_OVER, None])
    trials = list(labelled_trials(tmp_path))
    assert [t.unsafe for t in trials] == [False, True, False, True, True]


@pytest.mark.parametrize(("placed", "needed"), [(58, 72), (71, 72)])
def test_too_few_releases_are_refused_before_an_attempt_is_spent(
    tmp_path: Path, placed: int, needed: int
) -> None:
    record_run(tmp_path, "1", [Outcome.PLACED] * placed)
    record_run(tmp_path, "2", [Outcome.PLACED] * 5, bench_sha256="d" * 64)
    with pytest.raises(InputError) as refused:
        certify_laboratory(list(labelled_trials(tmp_path)), lab_bench(tmp_path))
    assert refused.value.what == (
        f"{placed} releases with an outcome cannot show at most 5 %: attempt 1 needs {needed}, "
        "none of them unsafe. 5 trials are of another bench."
    )
    assert not (tmp_path / "calibrations").exists()


def test_trials_of_an_attempt_are_not_used_again(tmp_path: Path) -> None:
    runs, bench = tmp_path / "runs", lab_bench(tmp_path)
    record_run(runs, "1", [Outcome.PLACED] * 100 + [Outcome.FELL] * 8)
    first = certify_laboratory(list(labelled_trials(runs)), bench)
    assert (first.certificate, first.path) == (None, None)
    record_run(runs, "2", [Outcome.PLACED] * 90)
    second = certify_laboratory(list(labelled_trials(runs)), bench)
    assert (second.attempt.number, second.attempt.counts[0].releases) == (2, 90)
    assert second.left_out == {"of an earlier attempt": 108}
    assert second.certificate is not None


def test_only_the_newest_model_and_method_count(tmp_path: Path) -> None:
    record_run(tmp_path, "1", [Outcome.FELL] * 30, risk=0.2)
    record_run(tmp_path, "2", [Outcome.FELL] * 30, weights_sha256="e" * 64)
    record_run(tmp_path, "3", [Outcome.PLACED] * 80)
    found = certify_laboratory(list(labelled_trials(tmp_path)), lab_bench(tmp_path))
    assert found.attempt.counts[0].unsafe == 0
    assert found.left_out == {"of another model or method": 60}


def test_command_writes_the_certificate_beside_the_calibrations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab_file = tmp_path / "lab.toml"
    assert main(["bench", str(lab_file), "--new", "--json"]) == 0
    capsys.readouterr()
    bench = load_lab(lab_file).identity
    runs, words = tmp_path / "runs", ["calibrate", "risk", str(tmp_path / "runs"), "--json"]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.touch()
    runs.mkdir()
    # Before the trials are read: there are none.
    assert main([*words, "--bench", str(lab_file), "--calibrations", str(elsewhere)]) == 2
    error = json.loads(capsys.readouterr().err)["error"]
    assert error["what"].startswith("The calibration cannot be written")
    assert error["where"] == str(elsewhere)
    record_run(runs, "1", [Outcome.PLACED] * 80, bench=bench.name, bench_sha256=bench.sha256)
    assert main([*words, "--bench", str(lab_file)]) == 0
    path = Path(json.loads(capsys.readouterr().out)["certificate"])
    assert path.parent == bench.calibrations
    assert read_certificate(path).simulated is False
    assert main([*words, "--bench", str(lab_file)]) == 2
    assert "80 trials are of an earlier attempt" in capsys.readouterr().err
    assert main(words) == 2
    assert "--bench" in capsys.readouterr().err


def test_interrupted_attempt_of_a_laboratory_ends_with_its_own_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, bench = tmp_path / "runs", lab_bench(tmp_path)
    record_run(runs, "1", [Outcome.PLACED] * 80)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    trials = list(labelled_trials(runs))
    with monkeypatch.context() as patch:
        patch.setattr(AttemptLog, "closed", killed)
        with pytest.raises(KeyboardInterrupt):
            certify_laboratory(trials, bench)
    record_run(runs, "2", [Outcome.FELL] * 5)
    found = certify_laboratory(list(labelled_trials(runs)), bench)
    assert (found.attempt.number, found.attempt.state, found.attempt.scenes) == (1, "ended", 80)
    assert found.certificate is not None
    assert found.left_out == {"for the next attempt": 5}
