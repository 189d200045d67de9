"""Several models pre-label together: chosen by a folder, named in the source of what is taken."""

import numpy as np
import pytest

from tests.app.label.conftest import KEY
from touchdown.backend.bench.assembly import shipped_model
from touchdown.backend.learning.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture
def models(tmp_path):
    """A folder with the shipped model of the pot and two that differ a little."""
    folder, shipped = tmp_path / "seeds", load_checkpoint(shipped_model("pot"))
    folder.mkdir()
    rng = np.random.default_rng(3)
    for number, by in enumerate((0.0, 0.02, 0.02)):
        arrays = {
            name: (values * (1 + by * rng.normal(size=values.shape))).astype(np.float32)
            for name, values in shipped.arrays.items()
        }
        save_checkpoint(folder / f"seed-{number}.safetensors", arrays, shipped.card)
    return folder


def choose(desk, qtbot, words, said):
    desk.workspace.whole.choose_models()
    desk.page.words.setText(words)
    desk.press(KEY.Key_Return)
    qtbot.waitUntil(lambda: said in desk.page.message.text(), timeout=60_000)
    desk.settle()


def test_models_of_a_folder_pre_label_together(desk, qtbot, models):
    uuid, alone = desk.uuid, desk.now.item.model
    choose(desk, qtbot, str(models), "3 models of pot pre-label together.")
    assert desk.uuid == uuid
    together = desk.now.item.model
    assert len(together.weights.split("+")) == 3
    assert alone.weights in together.weights
    assert together.spread_mm > 0.0
    assert "and 2 more" in desk.page.model_line.text()
    assert "they differ by" in desk.page.model_line.text()
    desk.do(KEY.Key_M)
    head = desk.book.head(uuid)
    assert head.source == together.source
    assert head.label.sigma_um == round(1e3 * together.fit.sigma_mm)
    choose(desk, qtbot, "-", "The model in use pre-labels pot.")
    assert desk.now.item.model.weights == alone.weights


def test_a_folder_without_models_is_refused(desk, qtbot, tmp_path):
    before = desk.now.item.model.weights
    choose(desk, qtbot, str(tmp_path / "nowhere"), "There is no model of 'pot'")
    assert desk.now.item.model.weights == before
