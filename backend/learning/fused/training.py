"""Training of the fusion network in torch.

It trains on every prefix of every probe sequence and its mirror images.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import grid_sample, linear, relu, rms_norm
from torch.optim import Muon

from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import edge_normals
from touchdown.backend.learning.fused import features
from touchdown.backend.learning.training import Adam

MARGIN_REACH_MM = 36.0  # outermost nodes of the margins of a sequence
SQUARE_ROOT_OF_TWO_PI = math.sqrt(2.0 * math.pi)
LEAST_LOG_SD, MOST_LOG_SD = -4.0, 2.0


class FusedNet(nn.Module):
    """Network from the probes of one grasp to the distribution of the inset of a point."""

    def __init__(self, shape: features.FusedShape, seed: int) -> None:
        super().__init__()
        self.shape = shape
        generator = torch.Generator().manual_seed(seed)
        self.weights: nn.ParameterDict = nn.ParameterDict()
        for name, size in features.weight_shapes(shape).items():
            drawn = torch.randn(size, generator=generator) / math.sqrt(size[-1])
            self.weights[_key(name)] = drawn if len(size) > 1 else torch.zeros(size)

    @torch.no_grad()
    def load(self, arrays: Arrays) -> None:
        """Take the weights of a checkpoint of one network."""
        for key, weight in self.weights.items():
            weight.copy_(torch.from_numpy(arrays[key.replace("/", ".")]))

    def fused(self, probes: Tensor) -> Tensor:
        """Return the state (b, P, width) after each of the scaled probes (b, P, inputs)."""
        count = probes.shape[1]
        never = torch.full((count, count), -torch.inf, device=probes.device)
        later = torch.triu(never, diagonal=1)
        x = self._linear("probe2", relu(self._linear("probe", probes)))
        for layer in range(self.shape.layers):
            x = x + self._attended(layer, rms_norm(x, x.shape[-1:]), later)
            inner = relu(self._linear(f"{layer}.up", rms_norm(x, x.shape[-1:])))
            x = x + self._linear(f"{layer}.down", inner)
        return rms_norm(x, x.shape[-1:])

    def forward(self, probes: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log weight, mean and log sd (b, P, q, parts) of the inset of ``points``.

        ``points`` (b, P, q, 5) are evaluated after each probe. Lengths in units of 10 mm.
        """
        about = self._linear("about", self.fused(probes))[:, :, None]
        both = relu(self._linear("both", relu(about + self._linear("point", points))))
        weight, mean, log_sd = self._linear("answer", both).chunk(3, dim=-1)
        return (weight.log_softmax(dim=-1), mean, log_sd.clamp(LEAST_LOG_SD, MOST_LOG_SD))

    def _attended(self, layer: int, x: Tensor, later: Tensor) -> Tensor:
        b, count, width = x.shape
        heads = self.shape.heads
        asked = self._linear(f"{layer}.asks", x).view(b, count, 3, heads, width // heads)
        query, key, value = asked.permute(2, 0, 3, 1, 4)
        share = (query @ key.mT / math.sqrt(width // heads) + later).softmax(dim=-1)
        joined = (share @ value).transpose(1, 2).reshape(b, count, width)
        return self._linear(f"{layer}.joins", joined)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return linear(x, self.weights[_key(f"{name}.weight")], self.weights[_key(f"{name}.bias")])


def negative_log_likelihood(answer: tuple[Tensor, Tensor, Tensor], inset: Tensor) -> Tensor:
    """Return the negative log likelihood (b, P, q) of the true ``inset``."""
    weight, mean, log_sd = answer
    z = (inset[..., None] - mean) * torch.exp(-log_sd)
    log_p = weight - 0.5 * z**2 - log_sd - math.log(SQUARE_ROOT_OF_TWO_PI)
    return -log_p.logsumexp(dim=-1)


def _key(name: str) -> str:
    return name.replace(".", "/")


def checkpoint_arrays(net: FusedNet) -> dict[str, Tensor]:
    """Return the weights by the names of a checkpoint."""
    return {key.replace("/", "."): value.detach().cpu() for key, value in net.weights.items()}


POINTS = 8  # points evaluated after each probe: the centre of mass, four near it, three anywhere
NEAR_MM, ANYWHERE_MM = 2.5, 16.0
FIRST_OF_FIELDS = 2000  # sequences that determine the components of the fields
BATCHES_AT_ONCE = 8
MATRIX_RATE = 2.5  # learning rate of the inner matrices, relative to the others
Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class FusedTraining:
    """Hyperparameters of the training."""

    steps: int = 6000
    batch: int = 128
    learning_rate: float = 2e-3
    seed: int = 0
    shape: features.FusedShape = field(default_factory=features.FusedShape)
    kick_mm: float = 0.0  # sd per axis of the shift of the centre of mass at a release
    start: Arrays | None = None  # arrays of a network to fine-tune, with its scaling and fields
    shuffled: float = 0.5  # share of the sequences of a step whose probes are in random order
    wrench_alone: bool = False  # the network does not read the marker fields


@dataclass(frozen=True, slots=True)
class ProbeSequences:
    """Training data: n sequences of P probes.

    ``probes`` (n, P, inputs) not scaled; ``true_mm``, ``offset_mm`` (n, P, 2); ``com_mm`` (n, 2);
    ``normal`` (n, k, 2) and ``reach_mm`` (n, k): half planes of the support; ``there`` (n, P).
    ``margin_mm`` (n / 4 or n, m, m): margins at nodes in the frame of the bottom, without mirror
    images, m = 0 for convex bottoms.
    """

    probes: Tensor
    true_mm: Tensor
    offset_mm: Tensor
    com_mm: Tensor
    normal: Tensor
    reach_mm: Tensor
    margin_mm: Tensor
    there: Tensor

    def to(self, device: torch.device) -> ProbeSequences:
        """Return the sequences in the memory of ``device``."""
        return ProbeSequences(*(getattr(self, column.name).to(device) for column in fields(self)))

    def inset_mm(self, rows: Tensor, at: Tensor) -> Tensor:
        """Return the inset (b, P, q) of points ``at`` (b, P, q, 2), from the middle of the bottom.

        With margins it is the signed distance to the hull of the contact that the piece would have
        with its centre of mass there.
        """
        if self.margin_mm.shape[-1]:
            own = len(self.margin_mm)
            signs = torch.tensor(features.MIRROR_SIGNS).to(at)[rows // own][:, None, None]
            return interpolate(self.margin_mm[rows % own].float(), signs * at / MARGIN_REACH_MM)
        along = torch.einsum("bpqx,bkx->bpqk", at, self.normal[rows])
        return (self.reach_mm[rows][:, None, None] - along).amin(dim=-1)


def interpolate(nodes: Tensor, at: Tensor) -> Tensor:
    """Return values (b, P, q) between ``nodes`` (b, m, m) at ``at`` (b, P, q, 2) from -1 to 1."""
    return grid_sample(
        nodes[:, None], at, mode="bilinear", padding_mode="border", align_corners=True
    )[:, 0]


def prepare_sequences(
    parts: Iterable[Arrays], modes: NDArray[np.float32], *, mirror: bool
) -> ProbeSequences:
    """Prepare sequences of ``experiments.fusion``, with mirror images if ``mirror``.

    One part at a time is kept, since all marker fields at once would exceed the memory.
    """
    images = features.MIRRORS if mirror else features.MIRRORS[:1]
    blocks: list[list[list[NDArray[Any]]]] = [[] for _ in images]
    margins = []
    for part in parts:
        margins.append(part.get("margin_mm", np.empty((len(part["count"]), 0, 0), np.float32)))
        for own, (across_x, across_y) in zip(blocks, images, strict=True):
            own.append(_prepared(part, modes, across_x=across_x, across_y=across_y))
    ordered = [block for own in blocks for block in own]
    columns = [_joined([block.pop(0) for block in ordered]) for _ in range(len(ordered[0]))]
    return ProbeSequences(
        *map(torch.from_numpy, (*columns[:-1], np.concatenate(margins), columns[-1]))
    )


def _joined(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """Return arrays (n, k, ...) joined in order, padded with zeros to the largest k."""
    size = max(array.shape[1] for array in arrays)
    joined = np.zeros((sum(map(len, arrays)), size, *arrays[0].shape[2:]), arrays[0].dtype)
    first = 0
    for array in arrays:
        joined[first : first + len(array), : array.shape[1]] = array
        first += len(array)
    return joined


def _prepared(
    arrays: Arrays, modes: NDArray[np.float32], *, across_x: bool, across_y: bool
) -> list[NDArray[Any]]:
    """Return the columns of ``ProbeSequences`` for a part, mirrored in x, y, both or not.

    The margins are left out; they replace the half planes.
    """
    signs = np.array([-1.0 if across_x else 1.0, -1.0 if across_y else 1.0])
    wrench, seen = features.mirror_signals(
        arrays["wrench"], arrays["field"], across_x=across_x, across_y=across_y
    )
    face = features.GraspedFace(
        *(arrays[k].astype(np.float64) for k in ("reach_mm", "com_mm", "grip_height_mm"))
    ).mirrored(across_x=across_x, across_y=across_y)
    offset = arrays["offset_mm"] * signs
    inputs = features.probe_inputs(wrench, seen, offset, face, modes)
    piece = np.broadcast_to(face.inputs()[:, None], (*inputs.shape[:2], face.inputs().shape[-1]))
    corners = slice(0 if "margin_mm" in arrays else None)
    normal, reach = half_planes(arrays["support_mm"][:, corners].astype(np.float64))
    columns = (
        np.concatenate([inputs, piece], axis=-1),
        arrays["true_mm"] * signs,
        offset,
        face.com_mm,
        normal * signs,
        reach,
    )
    there = np.arange(inputs.shape[1]) < arrays["count"][:, None]
    return [*(column.astype(np.float32) for column in columns), there]


def half_planes(polygon_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return outward normals (n, k, 2) and offsets (n, k) of the edges of polygons (n, k, 2).

    An edge of length zero sets no limit.
    """
    start, normal = edge_normals(polygon_mm)
    reach = (start * normal).sum(axis=-1)
    none = (normal == 0.0).all(axis=-1)
    return normal, np.where(none, 1e6, reach)


class FusedTrainer:
    """Network and data of one training; the same seed gives the same weights on one thread.

    ``train`` and ``held_out`` are arrays of ``experiments.fusion`` in parts, read one by one.
    ``data``: counts of sequences and probes, and the hash of the training set, for the card.
    """

    def __init__(
        self,
        train: Iterable[Arrays],
        held_out: Iterable[Arrays],
        settings: FusedTraining,
        device: torch.device = torch.device("cpu"),  # noqa: B008 - a value, never changed
    ) -> None:
        self._settings, self._device = settings, device
        start, parts = settings.start, self._counted(train)
        first: list[Arrays] = []
        if start is None:
            while sum(len(part["count"]) for part in first) < FIRST_OF_FIELDS:
                if (part := next(parts, None)) is None:
                    break
                first.append(part)
            seen = [part["field"].reshape(-1, *part["field"].shape[-2:]) for part in first]
            self.modes = features.field_components(np.concatenate(seen))
        else:
            self.modes = start["modes"]
        sequences = prepare_sequences(chain(first, parts), self.modes, mirror=True)
        del first
        rows = sequences.probes[sequences.there]
        self.mean, spread = rows.mean(dim=0), rows.std(dim=0)
        self.scale: Tensor = torch.where(spread > 1e-6, spread, torch.ones(()))
        if settings.wrench_alone:
            self.scale[features.FIELDS] = features.UNREAD_SCALE
        self._train = sequences.to(device)
        self._held_out = prepare_sequences(held_out, self.modes, mirror=False).to(device)
        self.held_out_count: int = len(self._held_out.there)
        self.net: FusedNet = FusedNet(settings.shape, settings.seed).to(device)
        if start is not None:
            self.mean, self.scale = (torch.from_numpy(start[k].copy()) for k in ("mean", "scale"))
            self.net.load(start)
        learned = dict(self.net.weights.items())
        inner = [key for key, w in learned.items() if w.dim() == 2 and key != _key("answer.weight")]
        # Orthogonal updates of the inner matrices, as long as those of Adam (arXiv 2502.16982).
        matrices = [learned.pop(key) for key in inner]
        self._muon = Muon(matrices, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
        self._adam = Adam(learned.values(), settings.learning_rate)
        self._generator = torch.Generator(device).manual_seed(settings.seed + 1)

    def _counted(self, parts: Iterable[Arrays]) -> Iterator[Arrays]:
        digest = hashlib.sha256()
        self.data: dict[str, Any] = {"sequences": 0, "probes": 0}
        for part in parts:
            digest.update(data_sha256(part).encode())
            self.data["sequences"] += len(part["count"])
            self.data["probes"] += int(part["count"].sum())
            self.data["sha256"] = digest.hexdigest()
            yield part

    def steps(self) -> Iterator[float]:
        """Yield the loss (nats a point) of each step."""
        settings = self._settings
        for step in range(settings.steps):
            warm = min(1.0, (step + 1) / 100)
            share = 0.5 * (1.0 + math.cos(math.pi * step / settings.steps))
            self._adam.rate = settings.learning_rate * warm * share
            self._muon.param_groups[0]["lr"] = MATRIX_RATE * self._adam.rate
            if step % BATCHES_AT_ONCE == 0:
                batches = self._batches()
            rows, most = next(batches)
            order = self._order(rows, most)
            loss = self._loss(self._train, rows, order, self._generator)
            self.net.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._adam.step()
            self._muon.step()  # type: ignore[no-untyped-call]
            yield float(loss.detach())

    def _batches(self) -> Iterator[tuple[Tensor, int]]:
        """Yield rows and most probes of the next batches, each of sequences of similar length."""
        size = (BATCHES_AT_ONCE * self._settings.batch,)
        count, generator, device = len(self._train.probes), self._generator, self._device
        rows = torch.randint(count, size, generator=generator, device=device)
        probes, order = self._train.there[rows].sum(dim=1).sort(stable=True)
        batches = rows[order].view(BATCHES_AT_ONCE, -1)
        most = probes.view(BATCHES_AT_ONCE, -1).amax(dim=1).tolist()
        for k in torch.randperm(BATCHES_AT_ONCE, generator=generator, device=device).tolist():
            yield batches[k], most[k]

    @torch.no_grad()
    def held_out_loss(self) -> float:
        """Return the loss on the held-out sequences, at the same points every time."""
        generator = torch.Generator(self._device).manual_seed(7)
        rows = torch.arange(len(self._held_out.probes), device=self._device)
        most = int(self._held_out.there.sum(dim=1).max())
        order = torch.arange(most, device=self._device).expand(len(rows), -1)
        return float(self._loss(self._held_out, rows, order, generator))

    def _order(self, rows: Tensor, most: int) -> Tensor:
        """Return the order (b, ``most``) of the probes of ``rows``: as pressed, or a random one."""
        drawn = torch.rand((len(rows), most + 1), generator=self._generator, device=self._device)
        pressed = torch.arange(most, device=self._device, dtype=drawn.dtype)
        shuffled = drawn[:, :1] < self._settings.shuffled
        place = torch.where(shuffled, drawn[:, 1:], pressed)
        return (place + most * ~self._train.there[rows, :most]).argsort(dim=1)

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return the arrays of a checkpoint."""
        found = {name: value.numpy().copy() for name, value in checkpoint_arrays(self.net).items()}
        about = {"mean": self.mean.numpy(), "scale": self.scale.numpy(), "modes": self.modes}
        return {**about, **found}

    def _loss(
        self, data: ProbeSequences, rows: Tensor, order: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Return the mean loss after each of the probes ``order`` (b, P) of ``rows`` (b,)."""
        row, device = rows[:, None], rows.device
        there = data.there[row, order][..., None]
        points = _points(data, rows, order.shape[1], generator)
        moved = points + data.true_mm[row, order][:, :, None]
        if kick := self._settings.kick_mm:
            noise = torch.randn(points.shape, generator=generator, device=device)
            moved = moved + kick * noise
        inset = data.inset_mm(rows, moved) / features.LENGTH_MM
        offset = data.offset_mm[row, order]
        away = (offset - offset[:, :1])[:, :, None]
        distance = points.square().sum(dim=-1, keepdim=True).sqrt()
        asked = torch.cat([points, points + away, distance], dim=-1) / features.LENGTH_MM
        probes = data.probes[row, order]
        steps = offset.diff(dim=1, prepend=offset[:, :1])
        probes[..., features.WAY] = torch.cat([away[:, :, 0], steps], dim=-1) / features.LENGTH_MM
        probes = (probes - self.mean.to(device)) / self.scale.to(device)
        answer = self.net(torch.where(there, probes, 0.0), asked)
        loss = torch.where(there, negative_log_likelihood(answer, inset), 0.0)
        return loss.sum() / (there.sum() * POINTS)


def data_sha256(arrays: Arrays) -> str:
    """Return the hash that identifies a training set."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode() + np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _points(data: ProbeSequences, rows: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw points (b, count, q, 2) in mm from the face after each of the first ``count`` probes."""
    shape, com = (len(rows), count, POINTS, 2), data.com_mm[rows][:, None, None]
    drawn = torch.randn(shape, generator=generator, device=com.device)
    anywhere = 2.0 * torch.rand(shape, generator=generator, device=com.device) - 1.0
    spread = torch.tensor([0.0] + 4 * [NEAR_MM] + 3 * [0.0]).to(com)[:, None]
    wide = torch.tensor(5 * [0.0] + 3 * [ANYWHERE_MM]).to(com)[:, None]
    return com + spread * drawn + wide * anywhere
