"""A piece that an operator added, from its file to a measured model."""

import json
from importlib.resources import files
from pathlib import Path

import pytest

from backend.__main__ import main
from backend.learning.checkpoint import load_checkpoint
from backend.objects.catalogue import load_catalogue
from backend.objects.surface import face_points


@pytest.fixture
def pieces(tmp_path: Path) -> Path:
    """A folder with a smaller pot of the operator's own."""
    folder = tmp_path / "pieces"
    folder.mkdir()
    text = files("resources").joinpath("objects", "pot.toml").read_text("utf-8")
    assert "diameter_mm = " in text
    lines = [
        "diameter_mm = 20.0" if line.startswith("diameter_mm") else line
        for line in text.splitlines()
    ]
    (folder / "own.toml").write_text("\n".join(lines), "utf-8")
    return folder


@pytest.fixture
def model(pieces: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    words = ["models", "--pieces", "own", "--pieces-dir", str(pieces), "--out", str(tmp_path)]
    words += ["--episodes", "4", "--test-episodes", "2", "--epochs", "1", "--workers", "1"]
    assert main([*words, "--json"]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert list(json.loads(told.out)["models"]) == ["own"]
    return tmp_path / "own.safetensors"


def test_models_are_made_of_the_faces_of_own_pieces(pieces: Path, model: Path) -> None:
    points = face_points(load_catalogue(pieces).piece("own").face)
    assert len(points) != len(face_points(load_catalogue().piece("pot").face))
    card = load_checkpoint(model).card
    assert card.piece == "own"
    assert card.metrics["unseen_bottoms"]["all"]["episodes"] == 8


def test_a_model_of_an_own_piece_is_measured_with_its_folder_only(
    pieces: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    words = ["simulate", "--piece", "own", "--pieces", str(pieces), "--bottoms", "short"]
    assert main([*words, "--episodes", "3", "--seed", "5", "--out", str(data), "--json"]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(model), str(data), "--pieces", str(pieces), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["piece"] == "own"
    assert answer["scores"]["all"]["episodes"] == 3
    assert main(["evaluate", str(model), str(data), "--json"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "own" in json.loads(told.err)["error"]["what"]


def test_a_folder_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = str(tmp_path / "none")
    words = ["models", "--pieces", "own", "--pieces-dir", missing, "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 2
    assert json.loads(capsys.readouterr().err)["error"]["where"] == missing
    assert list(tmp_path.iterdir()) == []
