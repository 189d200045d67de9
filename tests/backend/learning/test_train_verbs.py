"""Training and evaluation from the command line and from a script."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from touchdown.backend.cli.command_line import main
from touchdown.backend.core.faults import InputError
from touchdown.backend.learning.checkpoint import load_card
from touchdown.backend.learning.fitting import evaluate
from touchdown.backend.learning.job import TrainingEpoch, TrainingFinished
from touchdown.backend.learning.training import computes_bfloat16
from touchdown.backend.learning.training_runs import train_model

PRECISION = "bfloat16" if computes_bfloat16(torch.device("cpu")) else "float32"
Data = Callable[[Path, int], Path]


def test_train_then_evaluate(
    tmp_path: Path, write_data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_data(tmp_path / "data", 36)
    out = tmp_path / "pot.safetensors"
    words = ["train", str(data), "--piece", "pot", "--out", str(out), "--epochs", "3"]
    words += ["--batch", "4", "--threads", "1", "--precision", PRECISION]
    assert main([*words, "--json"]) == 0
    captured = capsys.readouterr()
    answer = json.loads(captured.out)
    assert answer["episodes"] == 36
    assert answer["out"] == str(out)
    assert load_card(out).training["precision"] == PRECISION
    assert [point["epoch"] for point in answer["curve"]] == [1, 2, 3]
    assert captured.err == ""

    assert main(["evaluate", str(out), str(data), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert set(answer["scores"]) == {"circle15", "short", "all"}
    assert answer["scores"]["all"]["episodes"] == 36
    assert answer["scores"]["all"]["point_accuracy"] > 0.9
    low, high = answer["scores"]["all"]["stability_interval"]
    assert low <= answer["scores"]["all"]["stability_accuracy"] <= high

    assert main(["evaluate", str(out), str(data)]) == 0
    assert "circle15" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("extra", "where"),
    [(["--epochs", "0"], "arguments"), (["--modality", "smell"], "touchdown train")],
)
def test_bad_arguments_are_one_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str], where: str
) -> None:
    assert main(["train", str(tmp_path), *extra, "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert json.loads(captured.err)["error"]["where"] == where


def test_missing_data_is_one_error_naming_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", str(tmp_path / "none"), "--json"]) == 2
    assert json.loads(capsys.readouterr().err)["error"]["where"] == str(tmp_path / "none")


def test_a_script_gets_the_numbers_of_the_command_line(
    tmp_path: Path, write_data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_data(tmp_path / "data", 36)
    by_verb, by_call = tmp_path / "verb.safetensors", tmp_path / "call.safetensors"
    words = ["train", str(data), "--out", str(by_verb), "--epochs", "2", "--modality", "FT"]
    assert main([*words, "--batch", "4", "--threads", "1", "--json"]) == 0
    curve = json.loads(capsys.readouterr().out)["curve"]
    reports: list[object] = []
    card = train_model(
        str(data), "pot", str(by_call), epochs=2, modality="FT", batch=4, threads=1,
        on_report=reports.append,
    )  # fmt: skip
    assert card == load_card(by_verb) == load_card(by_call)
    told = [r.validation_loss for r in reports if isinstance(r, TrainingEpoch)]
    assert told == [point["validation_loss"] for point in curve]
    assert isinstance(reports[-1], TrainingFinished)

    assert main(["evaluate", str(by_verb), str(data), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["scores"]
    assert {name: s.as_json() for name, s in evaluate(by_call, str(data)).items()} == shown


def test_a_training_from_a_script_names_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="epochs"):
        train_model(tmp_path, "pot", tmp_path / "pot.safetensors", epochs=0)
    with pytest.raises(InputError) as missing:
        train_model(tmp_path / "none", "pot", tmp_path / "pot.safetensors")
    assert missing.value.where == str(tmp_path / "none")
    with pytest.raises(InputError, match="folder"):
        train_model(tmp_path, "pot", tmp_path)
