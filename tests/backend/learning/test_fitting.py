"""Errors of trainings that cannot succeed."""

from collections.abc import Callable
from pathlib import Path

import pytest

from touchdown.backend.config.method import TrainingSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.learning.fitting import fit_model
from touchdown.backend.learning.job import TrainingJob, default_threads


def test_divergence_is_named_and_leaves_no_model(
    tmp_path: Path, write_data: Callable[[Path], Path]
) -> None:
    out = tmp_path / "pot.safetensors"
    job = TrainingJob(
        data=write_data(tmp_path / "data"),
        piece="pot",
        out=out,
        settings=TrainingSettings(hidden=4, epochs=9, patience=1, learning_rate=1e20),
        threads=1,
    )
    with pytest.raises(InputError, match="diverged"):
        fit_model(job, lambda _: None, lambda: False)
    assert not out.exists()


@pytest.mark.parametrize(("cores", "threads"), [(None, 1), (1, 1), (2, 2), (16, 2)])
def test_a_training_alone_takes_two_threads_where_there_are_two_cores(
    cores: int | None, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    assert default_threads() == threads
