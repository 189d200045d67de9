"""A piece added by the operator, from its file to a trained model."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from importlib.resources import files
from pathlib import Path

import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.learning.checkpoint import load_checkpoint


@pytest.fixture(scope="module")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a smaller pot of the operator's own."""
    folder = tmp_path_factory.mktemp("pieces")
    text = files("touchdown.resources").joinpath("objects", "pot.toml").read_text("utf-8")
    assert "diameter_mm = " in text
    lines = [
        "diameter_mm = 20.0" if line.startswith("diameter_mm") else line
        for line in text.splitlines()
    ]
    (folder / "own.toml").write_text("\n".join(lines), "utf-8")
    return folder


@pytest.fixture(scope="module")
def model(pieces: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    words = ["models", "--pieces", "own", "--pieces-dir", str(pieces), "--out", str(folder)]
    words += ["--episodes", "4", "--test-episodes", "2", "--epochs", "1", "--workers", "1"]
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        assert main([*words, "--json"]) == 0
    assert err.getvalue() == ""
    assert list(json.loads(out.getvalue())["models"]) == ["own"]
    return folder / "own.safetensors"


def test_models_are_made_of_the_faces_of_own_pieces(pieces: Path, model: Path) -> None:
    points = face_points(load_pieces(pieces).piece("own").face)
    assert len(points) != len(face_points(load_pieces().piece("pot").face))
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
