"""The verbs on the command line, end to end."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from touchdown.backend.__main__ import main
from touchdown.backend.learning.checkpoint import load_card
from touchdown.backend.learning.training import computes_bfloat16

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
