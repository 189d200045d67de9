"""Training of the patch network in torch: model, optimisers, device, resumable state.

Adam: Kingma and Ba 2015, arXiv 1412.6980. Muon: Liu et al. 2025, arXiv 2502.16982. The network has
two LSTM layers; the last time step gives one logit per face point. A training is a generator of
epochs; resuming from its saved state is exact.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_tensors
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.optim.adam import adam

from touchdown.backend.config import TrainingSettings
from touchdown.backend.core import InputError, parse_json, write_atomically
from touchdown.backend.episodes import Split, TrainingRows, split_rows
from touchdown.backend.learning.checkpoint import Checkpoint
from touchdown.backend.learning.inference import (
    NetworkShape,
    Normaliser,
    fit_normaliser_in_parts,
    modality_columns,
)
from touchdown.backend.learning.metrics import CONTACT_LEVEL, iou, point_accuracy, reliability
from touchdown.backend.learning.training_process import DeviceName, TrainingEpoch


def select_device(asked: DeviceName) -> torch.device:
    """Return the device ``asked`` for; ``auto`` is the first graphics processor, if any.

    Raises ``InputError`` for ``cuda`` if torch finds none.
    """
    found = torch.cuda.is_available()
    if asked == "cuda" and not found:
        fix = "Train on --device cpu, or install its driver and a torch that is built for it."
        raise InputError("There is no graphics processor that torch can use here.", "device", fix)
    return torch.device("cuda" if found and asked != "cpu" else "cpu")


def device_name(device: torch.device) -> str:
    """Return the name of the device for model cards."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def computes_bfloat16(device: torch.device) -> bool:
    """Return True if an LSTM can be trained with bfloat16 products on ``device``.

    On a processor oneDNN requires AVX-512.
    """
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return "AVX512" in torch.backends.cpu.get_cpu_capability()


def use_deterministic_algorithms(threads: int) -> None:
    """Use this number of threads, and deterministic algorithms, in this process.

    Call it before the first computation on a graphics processor: cuBLAS is reproducible only with a
    workspace of fixed size (cuBLAS manual, "Results reproducibility").
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.set_num_threads(threads)
    # torch.use_deterministic_algorithms would also load the compiler of torch.
    torch.set_deterministic_debug_mode("error")


def use_one_thread() -> None:
    """Train and predict on one thread, with the same results on every machine."""
    use_deterministic_algorithms(1)


class PatchNet(nn.Module):
    """Network from raw channels (B, 20, inputs) to logits (B, points), with standardisation."""

    mean: Tensor
    scale: Tensor

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.shape = shape
        self.register_buffer("mean", torch.zeros(shape.inputs))
        self.register_buffer("scale", torch.ones(shape.inputs))
        self.lstm: nn.LSTM = nn.LSTM(shape.inputs, shape.hidden, shape.layers, batch_first=True)
        self.head: nn.Linear = nn.Linear(shape.hidden, shape.points)

    def set_normaliser(self, normaliser: Normaliser) -> None:
        """Set mean and scale."""
        self.mean.copy_(torch.from_numpy(normaliser.mean))
        self.scale.copy_(torch.from_numpy(normaliser.scale))

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return the weights by name, as stored in a checkpoint."""
        return {name: tensor.numpy(force=True) for name, tensor in self.state_dict().items()}

    def forward(self, observation: Tensor) -> Tensor:
        """Return logits (B, points)."""
        states, _ = self.lstm((observation - self.mean) / self.scale)
        return cast("Tensor", self.head(states[:, -1]))


def new_model(shape: NetworkShape, seed: int) -> PatchNet:
    """Return a newly initialised network, the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PatchNet(shape)


def load_network(checkpoint: Checkpoint) -> PatchNet:
    """Return the network of a loaded model in evaluation mode."""
    with torch.device("meta"):
        model = PatchNet(checkpoint.card.hyper)
    tensors = {name: torch.from_numpy(array.copy()) for name, array in checkpoint.arrays.items()}
    model.load_state_dict(tensors, strict=True, assign=True)
    model.requires_grad_(False)
    return model.eval()


# State per weight: mean gradient, mean squared gradient (shape of the weight), number of steps ().
MOMENTS = ("exp_avg", "exp_avg_sq", "step")


class Adam:
    """Adam optimiser: moments of ``parameters``, and the ``rate`` of the next step."""

    def __init__(self, parameters: Iterable[Tensor], rate: float) -> None:
        self.rate = rate
        self._parameters = list(parameters)
        self.moments: list[dict[str, Tensor]] = [
            {
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
                "step": torch.zeros((), device=parameter.device),
            }
            for parameter in self._parameters
        ]

    def zero_grad(self) -> None:
        """Clear the gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update every weight; each must have a gradient."""
        own = self.moments[: len(self._parameters)]
        means, squares, steps = ([kept[name] for kept in own] for name in MOMENTS)
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        # Fused: one pass over the weights, a quarter of the time of a step on a CPU.
        adam(
            self._parameters, gradients, means, squares, [], steps, fused=True, amsgrad=False,
            beta1=0.9, beta2=0.999, lr=self.rate, weight_decay=0.0, eps=1e-8, maximize=False,
        )  # fmt: skip

    def take_up(self, moments: Iterable[Mapping[str, Tensor]]) -> None:
        """Set the moments; raises ``KeyError`` or ``RuntimeError`` if they do not fit."""
        for kept, given in zip(self.moments, moments, strict=True):
            for name in kept:
                kept[name].copy_(given[name])


# Coefficients, momentum and length of the steps of Muon (arXiv 2502.16982, equations 2 and 7). The
# paper takes 5 iterations; with 4 the held-out loss of the patch network is the same.
NEWTON_SCHULZ, NEWTON_SCHULZ_STEPS = (3.4445, -4.7750, 2.0315), 4
MOMENTUM, LENGTH = 0.95, 0.2


def orthogonalised(matrix: Tensor, dtype: torch.dtype) -> Tensor:
    """Return about the nearest matrix with singular values of 1, by products in ``dtype``."""
    x = (matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T).to(dtype)
    x = x / x.norm().clamp(min=1e-7)
    a, b, c = NEWTON_SCHULZ
    for _ in range(NEWTON_SCHULZ_STEPS):
        square = x @ x.T
        x = torch.addmm(x, torch.addmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return (x if matrix.shape[0] <= matrix.shape[1] else x.T).to(matrix.dtype)


class MuonAdam(Adam):
    """Muon for ``matrices``, with steps as long as those of Adam; Adam for ``parameters``."""

    def __init__(
        self,
        matrices: Iterable[Tensor],
        parameters: Iterable[Tensor],
        rate: float,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(parameters, rate)
        self._matrices, self._dtype = list(matrices), dtype
        self.moments += [{"momentum": torch.zeros_like(matrix)} for matrix in self._matrices]

    def zero_grad(self) -> None:
        """Clear the gradients."""
        super().zero_grad()
        for matrix in self._matrices:
            matrix.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update every weight; each must have a gradient."""
        super().step()
        for matrix, kept in zip(self._matrices, self.moments[-len(self._matrices) :], strict=True):
            if (gradient := matrix.grad) is not None:
                kept["momentum"].lerp_(gradient, 1 - MOMENTUM)
                update = orthogonalised(gradient.lerp(kept["momentum"], MOMENTUM), self._dtype)
                matrix.sub_(update, alpha=self.rate * LENGTH * math.sqrt(max(matrix.shape)))


CPU = torch.device("cpu")
EPISODES_PER_PASS = 4096  # episodes in memory at once during a pass over all
EPISODES_PER_GRADIENT = 64  # of a batch at once on a CPU: their states fit its cache


def fingerprint(rows: TrainingRows) -> str:
    """Return the SHA-256 of all inputs and targets, which identifies a training set."""
    digest = hashlib.sha256()
    for start in range(0, len(rows), EPISODES_PER_PASS):
        digest.update(
            np.ascontiguousarray(rows.observation[start : start + EPISODES_PER_PASS]).tobytes()
        )
    digest.update(np.packbits(rows.patch).tobytes())
    digest.update("\n".join(str(label.get("episode")) for label in rows.labels).encode())
    return digest.hexdigest()


class Trainer:
    """Model, optimiser and data of one training.

    The order of the samples depends on seed and epoch only, so resuming needs no generator state.
    The weights of the epoch with the lowest validation loss are kept (or of the last, see
    ``settings.keep``); ``best_figures`` are their IoU and point accuracy on the validation side.
    ``device`` is used for computing; data stay in main memory. ``split``: both sides (None:
    split here). Raises ``InputError`` if the device does not support the precision.
    """

    def __init__(
        self,
        rows: TrainingRows,
        settings: TrainingSettings,
        device: torch.device = CPU,
        split: Split | None = None,
    ) -> None:
        if settings.precision == "bfloat16" and not computes_bfloat16(device):
            fix = "Train in float32."
            raise InputError("This processor cannot multiply in bfloat16.", "precision", fix)
        self.settings, self.device = settings, device
        self.split: Split = split or split_rows(
            rows, settings.validation_share, settings.seed, divide_series=settings.divide_series
        )
        self._rows, self._seen = rows, modality_columns(settings.modality)
        train = self.split.train
        self._targets = torch.from_numpy(rows.patch.astype(np.float32))
        inputs = self._seen.stop - self._seen.start
        shape = NetworkShape(inputs, settings.hidden, settings.layers, rows.patch.shape[1])
        self.model: PatchNet = new_model(shape, settings.seed).to(device)
        parts = (rows.inputs(index) for index in in_batches(train))
        self.model.set_normaliser(fit_normaliser_in_parts(parts, settings.modality))
        self.optimiser: Adam = _optimiser(self.model, settings)
        self.base_rate: float = float(rows.patch[train].mean())
        self.done: int = 0
        self.best_epoch, self.best_loss = 0, float("inf")
        self.best_figures = (0.0, 0.0)
        self.best_state: dict[str, Tensor] = self._weights()

    def start_from(self, checkpoint: Checkpoint) -> TrainingEpoch:
        """Take weights and normalisation of ``checkpoint`` as epoch 0; return its figures."""
        self.model.load_state_dict(load_network(checkpoint).state_dict())
        return self._validate(math.nan)

    def epochs(self, cancelled: Callable[[], bool] = lambda: False) -> Iterator[TrainingEpoch]:
        """Run the remaining epochs; stops without a report when ``cancelled`` returns True."""
        while not self.finished:
            train_loss = self._train_epoch(cancelled)
            if train_loss is None:
                return
            self.done += 1
            yield self._validate(train_loss)

    @property
    def finished(self) -> bool:
        """True after all epochs, or after ``patience`` epochs without improvement."""
        waited = self.done - self.best_epoch
        return self.done >= self.settings.epochs or waited >= self.settings.patience

    def best_model(self) -> PatchNet:
        """Return a model with the weights of the best epoch, in evaluation mode."""
        model = PatchNet(self.model.shape)
        model.load_state_dict(self.best_state)
        return model.eval()

    def predict_held_out(self) -> NDArray[np.float32]:
        """Return the probabilities (n, N) of the kept weights for the validation side."""
        parts = in_batches(self.split.held_out)
        model = self.best_model().to(self.device)
        logits = [predict_logits(model, self._inputs(index)).cpu() for index in parts]
        return np.asarray(torch.sigmoid(torch.cat(logits)).numpy(), dtype=np.float32)

    def _train_epoch(self, cancelled: Callable[[], bool]) -> float | None:
        rng = np.random.default_rng([self.settings.seed, self.done])
        order = rng.permutation(self.split.train)
        settings = self.settings
        self.optimiser.rate = settings.learning_rate
        if settings.schedule == "cosine":
            self.optimiser.rate *= 0.5 * (1 + math.cos(math.pi * self.done / settings.epochs))
        self.model.train()
        coarse = settings.precision == "bfloat16"
        at_once = EPISODES_PER_GRADIENT if self.device.type == "cpu" else settings.batch
        total = 0.0
        for batch in in_batches(order, settings.batch):
            if cancelled():
                return None
            self.optimiser.zero_grad()
            for part in in_batches(batch, at_once):
                with torch.autocast(self.device.type, torch.bfloat16, enabled=coarse):
                    logits = self.model(self._inputs(part))
                targets = self._targets[part].to(self.device)
                loss = binary_cross_entropy_with_logits(logits.float(), targets)
                (loss * (len(part) / len(batch))).backward()  # type: ignore[no-untyped-call]
                total += float(loss.detach()) * len(part)
            self.optimiser.step()
        return total / len(order)

    def _validate(self, train_loss: float) -> TrainingEpoch:
        model, held_out = self.model.eval(), self.split.held_out
        parts = [predict_logits(model, self._inputs(index)).cpu() for index in in_batches(held_out)]
        logits, targets = torch.cat(parts), self._targets[held_out]
        loss = float(binary_cross_entropy_with_logits(logits, targets))
        probability = torch.sigmoid(logits).numpy()
        predicted = probability > CONTACT_LEVEL
        truth = targets.numpy() > CONTACT_LEVEL
        figures = (iou(predicted, truth), point_accuracy(predicted, truth))
        if loss < self.best_loss or self.settings.keep == "last":
            self.best_epoch, self.best_loss, self.best_state = self.done, loss, self._weights()
            self.best_figures = figures
        return TrainingEpoch(
            epoch=self.done,
            epochs=self.settings.epochs,
            train_loss=train_loss,
            validation_loss=loss,
            iou=figures[0],
            point_accuracy=figures[1],
            best_epoch=self.best_epoch,
            reliability=reliability(probability, truth),
        )

    def _inputs(self, index: NDArray[np.int64]) -> Tensor:
        """Return the inputs (B, 20, inputs) of the episodes at ``index`` on the device."""
        seen = self._rows.inputs(index)[:, :, self._seen]
        return torch.from_numpy(np.ascontiguousarray(seen)).to(self.device)

    def _weights(self) -> dict[str, Tensor]:
        state = self.model.state_dict()
        return {name: tensor.to("cpu", copy=True) for name, tensor in state.items()}


def _optimiser(model: PatchNet, settings: TrainingSettings) -> Adam:
    rate = settings.learning_rate
    if settings.optimiser == "Adam":
        return Adam(model.parameters(), rate)
    named = list(model.named_parameters())
    inner = {name for name, weight in named if weight.dim() == 2 and name.startswith("lstm.")}
    matrices, others = ([w for n, w in named if (n in inner) is chosen] for chosen in (True, False))
    coarse = computes_bfloat16(matrices[0].device)  # suffices for directions of equal length
    return MuonAdam(matrices, others, rate, torch.bfloat16 if coarse else torch.float32)


def in_batches(index: NDArray[np.int64], size: int = EPISODES_PER_PASS) -> list[NDArray[np.int64]]:
    """Divide ``index`` into parts of at most ``size``."""
    return [index[start : start + size] for start in range(0, len(index), size)]


def predict_logits(model: PatchNet, inputs: Tensor, batch: int = 512) -> Tensor:
    """Return the logits (n, N) of ``inputs`` (n, 20, inputs)."""
    with torch.inference_mode():
        return torch.cat([model(part) for part in torch.split(inputs, batch)])


def predict(model: PatchNet, observation: NDArray[np.float32], part: slice) -> NDArray[np.float32]:
    """Return the probabilities (n, N) for the columns ``part`` of ``observation`` (n, 20, 258)."""
    inputs = torch.from_numpy(np.ascontiguousarray(observation[:, :, part]))
    probability: NDArray[np.float32] = torch.sigmoid(predict_logits(model, inputs)).numpy()
    return probability


FORMAT = "touchdown-resume/1"
FIX = "Start again without --resume."


def resume_path(model_path: Path) -> Path:
    """Return the path of the saved state of the training of ``model_path``."""
    return model_path.with_suffix(".resume.safetensors")


def save_training_state(path: Path, trainer: Trainer, data: str) -> None:
    """Save everything the next epoch depends on; ``data`` is the fingerprint of the data."""
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


def load_training_state(path: Path, trainer: Trainer, data: str) -> None:
    """Restore the saved state of ``trainer``; raises ``InputError`` if it does not fit.

    Data and settings must be the same: the learning rate depends on the number of epochs.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise ValueError("foreign file")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        facts = parse_json(header["facts"])
        settings = TrainingSettings.model_validate(facts["settings"])
        if settings != trainer.settings or facts["data"] != data:
            raise InputError("The saved training used other data or settings.", str(path), FIX)
        trainer.model.load_state_dict(_under("model.", tensors))
        trainer.best_state = _under("best.", tensors)
        count = len(trainer.optimiser.moments)
        trainer.optimiser.take_up(_under(f"adam.{n}.", tensors) for n in range(count))
        trainer.done, trainer.best_epoch = int(facts["done"]), int(facts["best_epoch"])
        trainer.best_loss = float(facts["best_loss"])
        trainer.best_figures = (float(facts["best_figures"][0]), float(facts["best_figures"][1]))
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise InputError("There is no usable training to resume.", str(path), FIX) from error


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): torch.clone(tensor)
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }
