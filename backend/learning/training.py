"""Train one model: a generator of epochs, with a state that resumes exactly."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from backend.config.method import TrainingSettings
from backend.core.faults import InputError
from backend.dataset.rows import TrainingRows
from backend.dataset.splits import Split, split_rows
from backend.learning.adam import Adam
from backend.learning.device import computes_bfloat16
from backend.learning.features import columns, fit_in_parts
from backend.learning.metrics import LEVEL, ReliabilityBin, iou, point_accuracy, reliability
from backend.learning.model import PatchNet, new_model
from backend.learning.shape import Shape

CPU = torch.device("cpu")
PART = 4096
"""Episodes held in memory at once where all are gone through."""


@dataclass(frozen=True, slots=True)
class EpochReport:
    """One finished epoch; ``epoch`` counts from 1. Losses are mean BCE per point (nats).

    All but ``train_loss`` are measured on the validation side.
    """

    epoch: int
    epochs: int
    train_loss: float
    validation_loss: float
    iou: float
    point_accuracy: float
    best_epoch: int
    reliability: tuple[ReliabilityBin, ...]


def fingerprint(rows: TrainingRows) -> str:
    """Return the SHA-256 of all inputs and targets, which names a training set."""
    digest = hashlib.sha256()
    for start in range(0, len(rows), PART):
        digest.update(np.ascontiguousarray(rows.observation[start : start + PART]).tobytes())
    digest.update(np.packbits(rows.patch).tobytes())
    digest.update("\n".join(str(label.get("episode")) for label in rows.labels).encode())
    return digest.hexdigest()


class Trainer:
    """Model, optimiser and data of one training.

    The order of the samples depends on seed and epoch only, so that no generator state is needed to
    resume. The weights kept are those of the epoch with the lowest validation loss (or the last,
    as ``settings.keep`` says); ``best_figures`` are their IoU and point accuracy on the validation
    side. ``device`` computes; what is kept lies in main memory. ``InputError`` where it cannot
    compute in the precision that is asked for.
    """

    def __init__(
        self, rows: TrainingRows, settings: TrainingSettings, device: torch.device = CPU
    ) -> None:
        if settings.precision == "bfloat16" and not computes_bfloat16(device):
            raise InputError(
                "This processor cannot multiply in bfloat16.", "precision", "Train in float32."
            )
        self.settings, self.device = settings, device
        self.split: Split = split_rows(
            rows,
            settings.validation_share,
            settings.seed,
            divide_series=settings.divide_series,
        )
        self._rows, self._seen = rows, columns(settings.modality)
        train = self.split.train
        self._targets = torch.from_numpy(rows.patch.astype(np.float32))
        inputs = self._seen.stop - self._seen.start
        shape = Shape(inputs, settings.hidden, settings.layers, rows.patch.shape[1])
        self.model: PatchNet = new_model(shape, settings.seed).to(device)
        parts = (rows.inputs(index) for index in in_parts(train))
        self.model.set_normaliser(fit_in_parts(parts, settings.modality))
        self.optimiser = Adam(self.model.parameters(), settings.learning_rate)
        self.base_rate = float(rows.patch[train].mean())
        self.done = 0
        self.best_epoch, self.best_loss = 0, float("inf")
        self.best_figures = (0.0, 0.0)
        self.best_state = self._weights()

    def epochs(self, cancelled: Callable[[], bool] = lambda: False) -> Iterator[EpochReport]:
        """Run the remaining epochs; stops without a report when ``cancelled`` says so."""
        while not self.finished:
            train_loss = self._train_epoch(cancelled)
            if train_loss is None:
                return
            self.done += 1
            yield self._validate(train_loss)

    @property
    def finished(self) -> bool:
        """Whether all epochs are done, or none got better for as long as ``patience`` says."""
        waited = self.done - self.best_epoch
        return self.done >= self.settings.epochs or waited >= self.settings.patience

    def best_model(self) -> PatchNet:
        """Return a model with the weights of the best epoch, in evaluation mode."""
        model = PatchNet(self.model.shape)
        model.load_state_dict(self.best_state)
        return model.eval()

    def predict_held_out(self) -> NDArray[np.float32]:
        """(n, N) probabilities of the kept weights for the validation side."""
        parts = in_parts(self.split.held_out)
        model = self.best_model().to(self.device)
        logits = [predict_logits(model, self._inputs(index)).cpu() for index in parts]
        return np.asarray(torch.sigmoid(torch.cat(logits)).numpy(), dtype=np.float32)

    def _train_epoch(self, cancelled: Callable[[], bool]) -> float | None:
        rng = np.random.default_rng([self.settings.seed, self.done])
        order = rng.permutation(self.split.train)
        self._set_rate()
        self.model.train()
        coarse = self.settings.precision == "bfloat16"
        total = 0.0
        for batch in in_parts(order, self.settings.batch):
            if cancelled():
                return None
            self.optimiser.zero_grad()
            with torch.autocast(self.device.type, torch.bfloat16, enabled=coarse):
                logits = self.model(self._inputs(batch))
            loss = bce(logits.float(), self._targets[batch].to(self.device))
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimiser.step()
            total += float(loss.detach()) * len(batch)
        return total / len(order)

    def _set_rate(self) -> None:
        settings = self.settings
        rate = settings.learning_rate
        if settings.schedule == "cosine":
            rate *= 0.5 * (1 + math.cos(math.pi * self.done / settings.epochs))
        self.optimiser.rate = rate

    def _validate(self, train_loss: float) -> EpochReport:
        model, held_out = self.model.eval(), self.split.held_out
        parts = [predict_logits(model, self._inputs(index)).cpu() for index in in_parts(held_out)]
        logits, targets = torch.cat(parts), self._targets[held_out]
        loss = float(bce(logits, targets))
        probability = torch.sigmoid(logits).numpy()
        predicted = probability > LEVEL
        truth = targets.numpy() > LEVEL
        figures = (iou(predicted, truth), point_accuracy(predicted, truth))
        if loss < self.best_loss or self.settings.keep == "last":
            self.best_epoch, self.best_loss, self.best_state = self.done, loss, self._weights()
            self.best_figures = figures
        return EpochReport(
            self.done,
            self.settings.epochs,
            train_loss,
            loss,
            *figures,
            self.best_epoch,
            reliability(probability, truth),
        )

    def _inputs(self, index: NDArray[np.int64]) -> Tensor:
        """(B, 20, inputs) what the model sees of the episodes at ``index``, where it computes."""
        seen = self._rows.inputs(index)[:, :, self._seen]
        return torch.from_numpy(np.ascontiguousarray(seen)).to(self.device)

    def _weights(self) -> dict[str, Tensor]:
        state = self.model.state_dict()
        return {name: tensor.to("cpu", copy=True) for name, tensor in state.items()}


def in_parts(index: NDArray[np.int64], size: int = PART) -> list[NDArray[np.int64]]:
    """Return ``index`` in pieces of at most ``size``."""
    return [index[start : start + size] for start in range(0, len(index), size)]


def bce(logits: Tensor, targets: Tensor) -> Tensor:
    """Mean binary cross-entropy over samples and points, from logits (B, N)."""
    return binary_cross_entropy_with_logits(logits, targets)


def predict_logits(model: PatchNet, inputs: Tensor, batch: int = 512) -> Tensor:
    """(n, N) logits of ``inputs`` (n, 20, inputs)."""
    with torch.inference_mode():
        return torch.cat([model(part) for part in torch.split(inputs, batch)])


def predict(model: PatchNet, observation: NDArray[np.float32], part: slice) -> NDArray[np.float32]:
    """(n, N) probabilities for ``observation`` (n, 20, 258), of which the model sees ``part``."""
    inputs = torch.from_numpy(np.ascontiguousarray(observation[:, :, part]))
    probability: NDArray[np.float32] = torch.sigmoid(predict_logits(model, inputs)).numpy()
    return probability
