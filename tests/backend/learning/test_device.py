"""What computes a training: chosen by itself, named, refused where it is not there."""

import numpy as np
import pytest
import torch

from backend.__main__ import main
from backend.core.faults import InputError
from backend.learning.device import computes_bfloat16, device_of, name_of
from backend.learning.training import Trainer
from tests.backend.learning.test_learning import SMALL, rows

GPU = torch.cuda.is_available()


def test_a_graphics_processor_is_taken_where_torch_finds_one(monkeypatch):
    for found, asked, chosen in (
        (True, "auto", "cuda"), (False, "auto", "cpu"), (True, "cpu", "cpu"),
        (False, "cpu", "cpu"), (True, "cuda", "cuda"),
    ):  # fmt: skip
        monkeypatch.setattr(torch.cuda, "is_available", lambda found=found: found)
        assert device_of(asked).type == chosen
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no graphics processor"):
        device_of("cuda")
    assert name_of(device_of("auto")) == "cpu"


@pytest.mark.skipif(GPU, reason="there is one")
def test_a_training_on_what_is_not_there_is_refused_in_one_sentence(tmp_path, write_data, capsys):
    data, out = write_data(tmp_path / "data", 36), tmp_path / "pot.safetensors"
    code = main(["train", str(data), "--device", "cuda", "--out", str(out)])
    said = capsys.readouterr().err
    assert code == 2
    assert "graphics processor" in said
    assert "--device cpu" in said
    assert not out.exists()


@pytest.mark.skipif(not GPU, reason="needs a graphics processor")
def test_a_graphics_processor_trains_what_a_processor_trains():
    data = rows(24)
    settings = SMALL.model_copy(update={"epochs": 3})
    here, there = Trainer(data, settings), Trainer(data, settings, device_of("cuda"))
    for ours, theirs in zip(here.epochs(), there.epochs(), strict=True):
        assert theirs.validation_loss == pytest.approx(ours.validation_loss, rel=1e-3)
    assert np.allclose(here.predict_held_out(), there.predict_held_out(), atol=1e-2)
    assert all(tensor.device.type == "cpu" for tensor in there.best_state.values())
    assert computes_bfloat16(there.device) in (True, False)
