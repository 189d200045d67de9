"""Device of a training: automatic, named, or refused if missing."""

import numpy as np
import pytest
import torch

from tests.backend.learning.test_learning import SMALL, rows
from touchdown.backend.cli.command_line import main
from touchdown.backend.core.faults import InputError
from touchdown.backend.learning.training import (
    Trainer,
    computes_bfloat16,
    device_name,
    select_device,
)

GPU = torch.cuda.is_available()


def test_a_graphics_processor_is_taken_where_torch_finds_one(monkeypatch):
    for found, asked, chosen in (
        (True, "auto", "cuda"), (False, "auto", "cpu"), (True, "cpu", "cpu"),
        (False, "cpu", "cpu"), (True, "cuda", "cuda"),
    ):  # fmt: skip
        monkeypatch.setattr(torch.cuda, "is_available", lambda found=found: found)
        assert select_device(asked).type == chosen
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no graphics processor"):
        select_device("cuda")
    assert device_name(select_device("auto")) == "cpu"


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
    here, there = Trainer(data, settings), Trainer(data, settings, select_device("cuda"))
    for ours, theirs in zip(here.epochs(), there.epochs(), strict=True):
        assert theirs.validation_loss == pytest.approx(ours.validation_loss, rel=1e-3)
    assert np.allclose(here.predict_held_out(), there.predict_held_out(), atol=1e-2)
    assert all(tensor.device.type == "cpu" for tensor in there.best_state.values())
    assert computes_bfloat16(there.device) in (True, False)
