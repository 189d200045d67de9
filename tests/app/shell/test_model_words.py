"""Which model reads a probe is said where strategy and probe are chosen."""

import pytest

from tests.app.conftest import settle
from touchdown.app.shell.bench_text import (
    card_caption,
    model_card_in_use,
    run_model_caption,
    scene_model_caption,
)
from touchdown.backend.bench.assembly import model_in_use
from touchdown.backend.learning import ModelRegistry, load_checkpoint, save_checkpoint
from touchdown.backend.runs import LEARNED
from touchdown.backend.runs.recorder import models_folder
from touchdown.widgets.forms.run_form import RunForm


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.setenv("TOUCHDOWN_DATA", str(tmp_path / "data"))


@pytest.fixture
def mine(tmp_path):
    """A model of twenty probes for the pot, not in use yet, and its card."""
    shipped = load_checkpoint(model_in_use("pot", None))
    arrays = {**shipped.arrays, "head.bias": shipped.arrays["head.bias"] + 1}
    told = {"data": {"episodes": {"short": 12, "long": 8}}, "metrics": {"validation": {"iou": 0.4}}}
    model = tmp_path / "mine.safetensors"
    return model, save_checkpoint(model, arrays, shipped.card.model_copy(update=told))


def test_the_words_follow_what_is_in_use(mine):
    model, card = mine
    assert run_model_caption("pot", "paper").short.startswith("shipped, IoU ")
    assert "12,000 probes" in run_model_caption("pot", "paper").full
    ModelRegistry(models_folder()).promote(model)
    own = run_model_caption("pot", "paper")
    assert own.short == f"yours {card.weights_sha256[:8]}, IoU 40 %, 20 probes"
    assert "promoted in Train" in own.full
    told = {"pretrained": {"weights_sha256": "ab" * 32, "data": {}}, "mixed": {"episodes": 5}}
    full = card_caption(card.model_copy(update={"data": card.data | told})).full
    assert "Fine-tuned from the model abababababab." in full
    assert "5 of the training probes were mixed in." in full
    assert run_model_caption("barrel", "paper").short.startswith("shipped")
    ModelRegistry(models_folder()).roll_back("pot")
    assert run_model_caption("pot", "paper").short.startswith("shipped")


def test_strategies_that_ask_no_promoted_model_say_so(mine):
    ModelRegistry(models_folder()).promote(mine[0])
    shorts = [
        run_model_caption("pot", name).short for name in ("fused", "zero-wrench", "pick-and-place")
    ]
    assert not any("yours" in short for short in shorts)
    assert shorts[0] == "its own, shipped"
    shipped = [run_model_caption("pot", name).full.split()[5] for name in LEARNED]
    assert len(set(shipped)) == 3, "three networks ship, two of them with several rules"


def test_a_damaged_history_is_no_failure():
    models_folder().mkdir(parents=True)
    (models_folder() / "in-use.jsonl").write_text('{"piece": "pot"}\n', "utf-8")
    words = run_model_caption("pot", "paper")
    assert words.short == "cannot be read"
    assert "shipped models are used" in words.full


def test_a_scene_keeps_its_model_and_says_who_takes_the_other(mine):
    model, card = mine
    shipped = model_card_in_use("pot")
    ModelRegistry(models_folder()).promote(model)
    words = scene_model_caption(shipped, "pot", simulated=True)
    assert words.short.endswith(f"; next run: yours {card.weights_sha256[:8]}")
    assert "Set (Ctrl+N)" in words.full
    assert "Set" not in scene_model_caption(shipped, "pot", simulated=False).full
    assert "next run:" not in scene_model_caption(card, "pot", simulated=True).short
    assert scene_model_caption(None, "pot", simulated=True).short.endswith(
        ", loaded by the next run"
    )


def test_stack_and_operate_show_it(live, bench, mine):
    model, card = mine
    run, probe = (live.workspaces["stack"].page.run, live.workspaces["operate"].page.probe)
    assert run._model.text().startswith("shipped")
    for name in LEARNED:
        run.show_form(RunForm(strategy=name))
        assert run._model.text() == "its own, shipped"
        assert run._certificate.text().startswith("No certificate for this bench"), name
    run.show_form(RunForm())
    ModelRegistry(models_folder()).promote(model)
    live.go("operate")
    yours = f"yours {card.weights_sha256[:8]}"
    assert probe.model.text() == f"Model: {yours}, loaded by the next run"
    bench.model = card
    settle(live)
    assert probe.model.text() == f"Model: yours {card.weights_sha256[:8]}, IoU 40 %, 20 probes"
    live.go("stack")
    assert run._model.text() == f"yours {card.weights_sha256[:8]}, IoU 40 %, 20 probes"
