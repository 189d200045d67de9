"""Models of an experiment that are kept: whatever ends the writing, none is half another."""

from __future__ import annotations

import errno
import os
import shutil
from importlib.resources import files
from pathlib import Path

import pytest

from touchdown.backend.cli.experiment.command import report_write_errors
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.experiments.models import WEIGHTS, adopt_models, keep_models
from touchdown.backend.experiments.tables import FULL, Recipe
from touchdown.backend.jobs.job import JobStore
from touchdown.backend.learning.checkpoint import card_path, load_checkpoint

SHIPPED = Path(str(files("touchdown.resources"))) / "models" / "bench-v1"
RECIPE = Recipe(FULL, SimulationSettings(), "1", pieces=("pot",))
NAMES = ("FT", "FT+Tac")


class KilledError(BaseException):
    """What no code catches, as little as SIGKILL: what follows it is left undone."""


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> list[JobStore]:
    """Two experiments that trained two models each, under the same names."""
    made = []
    for shift in (0, 1):
        store = JobStore(tmp_path_factory.mktemp("jobs"))
        for k, name in enumerate(NAMES):
            spec = RECIPE.training("pot", name)
            given = SHIPPED / f"pot-{NAMES[(k + shift) % 2].lower()}.safetensors"
            with store.writing(spec) as part:
                shutil.copyfile(given, part / WEIGHTS)
                shutil.copyfile(card_path(given), card_path(part / WEIGHTS))
                store.finish(spec, part, {})
        made.append(store)
    return made


def at_call(monkeypatch: pytest.MonkeyPatch, name: str, ends: int, error: BaseException) -> None:
    """Let the ``ends``-th call of ``os.fsync`` or ``Path.replace`` raise ``error``."""
    owner = os if name == "fsync" else Path
    real, left = getattr(owner, name), iter(range(ends))

    def call(*args: object) -> object:
        if next(left, None) is None:
            raise error
        return real(*args)

    monkeypatch.setattr(owner, name, call)


def refusal(path: Path) -> InputError | None:
    """Return why a model is not loaded, which must name its file; None for one that is whole."""
    try:
        load_checkpoint(path)
    except InputError as error:
        return error if str(path.with_suffix("")) in error.where else pytest.fail(str(error))
    return None


POINTS = [("replace", 0), ("replace", 1), ("replace", 2), ("fsync", 1), ("fsync", 2)]
"""Each model is two files; each of them is synced, renamed, and then its folder is synced."""


@pytest.mark.parametrize(("name", "at"), POINTS)
def test_killed_at_any_point_each_model_is_whole_or_refused(
    stores: list[JobStore],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    at: int,
) -> None:
    keep_models(stores[0], RECIPE, tmp_path)
    whole = {p.name: load_checkpoint(p).card.weights_sha256 for p in tmp_path.glob("*.safetensors")}
    assert len(whole) == 2
    with monkeypatch.context() as patch:
        at_call(patch, name, at, KilledError())
        with pytest.raises(KilledError):
            keep_models(stores[1], RECIPE, tmp_path)
    told = [refusal(path) for path in sorted(tmp_path.glob("*.safetensors"))]
    assert len([error for error in told if error is not None]) <= 1
    kept = keep_models(stores[1], RECIPE, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        name for path in kept for name in (path.name, card_path(path).name)
    )
    again = {p.name: load_checkpoint(p).card.weights_sha256 for p in kept}
    assert set(again.values()) == set(whole.values())
    assert again != whole


def test_a_full_disk_is_one_clear_error_and_the_next_try_is_whole(
    stores: list[JobStore], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    with monkeypatch.context() as patch:
        at_call(patch, "fsync", 4, full)
        with pytest.raises(InputError, match="No space left"), report_write_errors(tmp_path):
            keep_models(stores[0], RECIPE, tmp_path)
    assert not list(tmp_path.glob(".*"))
    keep_models(stores[0], RECIPE, tmp_path)
    assert len(adopt_models(JobStore(tmp_path / "other"), tmp_path)) == 2
