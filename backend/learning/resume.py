"""Interrupted training on disk: one safetensors file, its scalars as JSON in the file's header."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_tensors
from torch import Tensor

from backend.config.method import TrainingSettings
from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.learning.training import Trainer

FORMAT = "touchdown-resume/1"
FIX = "Start again without --resume."


def resume_path(model_path: Path) -> Path:
    """Return where the state of the training of ``model_path`` is kept."""
    return model_path.with_suffix(".resume.safetensors")


def save_state(path: Path, trainer: Trainer, data: str) -> None:
    """Keep everything that the next epoch depends on; ``data`` is the data's fingerprint."""
    tensors: dict[str, Tensor] = {}
    tensors |= {f"model.{k}": v.contiguous() for k, v in trainer.model.state_dict().items()}
    tensors |= {f"best.{k}": v.contiguous() for k, v in trainer.best_state.items()}
    for number, moments in enumerate(trainer.optimiser.moments):
        tensors |= {f"adam.{number}.{k}": v.contiguous() for k, v in moments.items()}
    facts = {
        "data": data,
        "settings": trainer.settings.model_dump(),
        "done": trainer.done,
        "best_epoch": trainer.best_epoch,
        "best_loss": trainer.best_loss,
        "best_figures": trainer.best_figures,
    }
    header = {"format": FORMAT, "facts": json.dumps(facts)}
    write_atomically(path, save_tensors(tensors, metadata=header))


def load_state(path: Path, trainer: Trainer, data: str) -> None:
    """Bring ``trainer`` to where the saved training stopped; raises ``InputError`` if it differs.

    Data and settings must be the same: the learning rate depends on the number of epochs.
    """
    try:
        facts, tensors = _read(path)
        settings = TrainingSettings.model_validate(facts["settings"])
        if settings != trainer.settings or facts["data"] != data:
            raise InputError("The saved training used other data or settings.", str(path), FIX)
        _restore(trainer, tensors)
        trainer.done, trainer.best_epoch = int(facts["done"]), int(facts["best_epoch"])
        trainer.best_loss = float(facts["best_loss"])
        trainer.best_figures = (float(facts["best_figures"][0]), float(facts["best_figures"][1]))
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise InputError("There is no usable training to resume.", str(path), FIX) from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    with safe_open(str(path), framework="pt") as file:
        header = file.metadata() or {}
        if header.get("format") != FORMAT:
            raise ValueError("foreign file")
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    return json.loads(header["facts"]), tensors


def _restore(trainer: Trainer, tensors: dict[str, Tensor]) -> None:
    trainer.model.load_state_dict(_under("model.", tensors))
    trainer.best_state = _under("best.", tensors)
    count = len(trainer.optimiser.moments)
    trainer.optimiser.take_up(_under(f"adam.{n}.", tensors) for n in range(count))


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): torch.clone(tensor)
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


def forget_state(path: Path) -> None:
    """Delete the saved state, if any."""
    path.unlink(missing_ok=True)
