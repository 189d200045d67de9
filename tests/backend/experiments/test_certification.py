"""Certification: fresh scenes of an attempt, and the command with its files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.backend.cli import main
from touchdown.backend.config import load_simulation
from touchdown.backend.experiments.certification import (
    FAMILIES,
    Certification,
    fresh_scene,
    run_certified_scenes,
)
from touchdown.backend.experiments.job_kinds import KINDS
from touchdown.backend.experiments.tables import PIECES
from touchdown.backend.geometry import load_pieces
from touchdown.backend.jobs import JobContext, JobSpec, JobStore
from touchdown.backend.learning.fused import AttemptLog, attempts_path
from touchdown.backend.learning.fused.certificate import read_certificate
from touchdown.backend.learning.fused.checkpoint import shipped_path
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
    plan = Certification(BENCH, "bench-v1", weights, (0.07,), 2)
    job = plan.jobs(plan.begin(AttemptLog(attempts_path(weights))))[0]
    store = JobStore(tmp_path / "jobs")
    found = run_certified_scenes(job, JobContext(tmp_path, store))
    assert [t["seed"] for t in found["trials"]] == [job.seed, job.seed + 1]
    assert {t["outcome"] for t in found["trials"]} <= {"placed", "fell", "gave_up", "aborted"}


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
        words = ["fell"] * fell + ["gave_up"] * 4 + ["placed"] * (n - fell - 4)
        return {"trials": [{"seed": spec.seed + k, "outcome": w} for k, w in enumerate(words)]}

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
