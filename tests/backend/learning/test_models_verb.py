"""The recipe of the shipped models, small."""

import json
from pathlib import Path

import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.learning.checkpoint import load_checkpoint
from touchdown.backend.placement.estimator import Estimator


def test_the_recipe_leaves_a_measured_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["models", "--pieces", "pot", "--out", str(tmp_path), "--episodes", "6", "--json"]
    words += ["--test-episodes", "2", "--epochs", "1", "--probes-per-grip", "2", "--workers", "1"]
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    bottoms = {"short", "long", "hex20", "rect12x28", "all"}
    assert set(answer["models"]["pot"]["scores"]) == bottoms
    path = tmp_path / "pot.safetensors"
    card = load_checkpoint(path).card
    assert card.data["episodes"] == {"circle15": 6, "circle25": 6, "square15": 6}
    assert card.data["recipe"]["seed"] == 1
    assert set(card.metrics["unseen_bottoms"]) == bottoms
    assert card.metrics["unseen_bottoms"]["all"]["episodes"] == 8
    assert Estimator.load(path, load_pieces().piece("pot")).card == card
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pot.json", "pot.safetensors"]
