"""The experiments as jobs: which depend on which, at which size. Nothing is run here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from backend.config.bench_facts import bench_sha256
from backend.config.method import TrainingSettings
from backend.config.simulation import SimulationSettings
from backend.jobs.spec import JobSpec
from backend.learning.job import DeviceName

PIECES = ("mushroom", "barrel", "pot")
BOTTOMS = ("short", "long")
TRAINING_BOTTOMS = ("circle15", "circle25", "square15")
TWO = ("short", "long")
"""Bottom-up: Long stands on Short, and Long is touched."""
Head = Literal["patch", "stability"]
MODELS: tuple[tuple[str, str, Head], ...] = (
    ("FT", "FT", "patch"),
    ("Tac", "Tac", "patch"),
    ("FT+Tac", "FT+Tac", "patch"),
    ("Implicit", "FT+Tac", "stability"),
)
"""Name in the tables, inputs, and what the network answers."""
TRAINING_SEED, STATIC_SEED, STACKING_SEED = 21, 3_000_000, 4_000_000
"""Distances between cells are far below these: no seed serves twice."""
CELL_SEEDS = 10_000


@dataclass(frozen=True, slots=True)
class Scale:
    """How much of everything: ``probes`` for training per outline, groups and trials per cell."""

    name: str
    probes: int
    epochs: int
    groups: int
    trials: int
    probes_per_grip: int = 50
    grips_per_mounting: int = 40
    fused: int = 5
    pictured: int = 1500
    """Probes whose signals are shown and searched for presses that feel alike."""
    repeated: int = 0
    """Trials of each cell of Table 3 that are run on the devices as well, images and all."""


FULL = Scale("full", probes=2000, epochs=30, groups=400, trials=100, repeated=20)
QUICK = Scale("quick", probes=0, epochs=0, groups=40, trials=10, pictured=400)
SCALES = {scale.name: scale for scale in (FULL, QUICK)}


@dataclass(frozen=True)
class Recipe:
    """All jobs of Tables 1 to 3 on one bench.

    ``models``: for each piece and model name the hash of a trained file to use in place of a
    training; ``code`` is the version of the program.
    """

    scale: Scale
    bench: SimulationSettings
    code: str
    models: Mapping[tuple[str, str], str] = field(default_factory=dict)
    pieces: tuple[str, ...] = PIECES
    device: DeviceName = "auto"
    """What trains: another one gives other last digits."""

    def bench_id(self) -> str:
        """Return the SHA-256 of the bench's settings."""
        return bench_sha256(self.bench)

    def jobs(self) -> list[JobSpec]:
        """Return every job once, inputs before what needs them."""
        found: dict[str, JobSpec] = {}
        for spec in self._all():
            found.setdefault(spec.id, spec)
        return list(found.values())

    def data(self, piece: str) -> list[JobSpec]:
        """Return the collections of training probes of ``piece``, one per outline."""
        scale = self.scale
        facts: dict[str, Any] = {
            "piece": piece,
            "episodes": scale.probes,
            "probes_per_grip": scale.probes_per_grip,
            "grips_per_mounting": scale.grips_per_mounting,
        }
        return [self._job("simulate", TRAINING_SEED, bottom=b, **facts) for b in TRAINING_BOTTOMS]

    def training(self, piece: str, model: str) -> JobSpec:
        """Return the training of one model."""
        inputs, head = next((i, h) for name, i, h in MODELS if name == model)
        settings = paper_training(inputs, self.scale.epochs)
        needs = tuple(spec.id for spec in self.data(piece))
        params = {
            "piece": piece,
            "head": head,
            "training": settings.model_dump(mode="json"),
            "device": self.device,
        }
        return JobSpec("train", params, settings.seed, needs, self.code)

    def static(self, piece: str, bottom: str) -> JobSpec | None:
        """Return the evaluation of all models of ``piece`` over one bottom; None without any."""
        names = [name for name, _, _ in MODELS if self._source(piece, name)]
        if not names:
            return None
        sources = {name: self._source(piece, name) for name in names}
        return self._job(
            "static",
            STATIC_SEED + CELL_SEEDS * self._cell(piece, bottom),
            needs=tuple(sorted({s for s in sources.values() if s})),
            piece=piece,
            bottom=bottom,
            models=sources,
            groups=self.scale.groups,
            probes=self.scale.fused,
        )

    def stacking(self, piece: str, bottoms: tuple[str, ...], strategy: str) -> JobSpec | None:
        """Return one cell of Table 3; None without a model for a strategy that needs one."""
        source = self._source(piece, "FT+Tac") if strategy != "pick-and-place" else ""
        if source is None:
            return None
        tower = 5 if len(bottoms) > 1 else 0
        return self._job(
            "stack",
            STACKING_SEED + CELL_SEEDS * (self._cell(piece, bottoms[-1]) + tower),
            needs=(source,) if source else (),
            piece=piece,
            bottoms=list(bottoms),
            strategy=strategy,
            trials=self.scale.trials,
        )

    def devices(self, piece: str, bottoms: tuple[str, ...]) -> JobSpec | None:
        """Return the first trials of a cell on the stepped bench; None if there are to be none."""
        cell = self.stacking(piece, bottoms, "paper")
        if cell is None or not self.scale.repeated:
            return None
        params = {**cell.params, "trials": self.scale.repeated}
        return JobSpec("devices", params, cell.seed, cell.inputs, self.code)

    def twins(self) -> JobSpec:
        """Return the small collection whose signals are shown and searched for alike presses."""
        return self._job(
            "twins",
            TRAINING_SEED,
            piece=self.pieces[0],
            bottom=TRAINING_BOTTOMS[0],
            episodes=self.scale.pictured,
            probes_per_grip=self.scale.probes_per_grip,
            grips_per_mounting=self.scale.grips_per_mounting,
        )

    def effort(self, spec: JobSpec) -> int:
        """Return how long a job takes compared with others, for the time that is left."""
        p, scale = spec.params, self.scale
        if spec.kind in ("simulate", "twins"):
            return int(p["episodes"])
        if spec.kind == "train":
            return scale.probes * scale.epochs // 2
        if spec.kind == "static":
            return 5 * int(p["groups"]) * int(p["probes"]) // 2
        return (2000 if spec.kind == "devices" else 10) * int(p["trials"])

    def _all(self) -> Iterator[JobSpec]:
        for piece in self.pieces:
            if self.scale.probes:
                yield from self.data(piece)
                yield from (self.training(piece, name) for name, _, _ in MODELS)
        yield self.twins()
        for piece in self.pieces:
            cells = [self.static(piece, bottom) for bottom in BOTTOMS]
            for bottom in BOTTOMS:
                cells += [self.stacking(piece, (bottom,), s) for s in ("pick-and-place", "paper")]
            cells.append(self.stacking(piece, TWO, "paper"))
            cells += [self.devices(piece, tower) for tower in (*((b,) for b in BOTTOMS), TWO)]
            yield from (cell for cell in cells if cell is not None)

    def _source(self, piece: str, model: str) -> str | None:
        """Return the job or the hash that a model comes from."""
        if (piece, model) in self.models:
            return self.models[piece, model]
        return self.training(piece, model).id if self.scale.probes else None

    def _job(self, kind: str, seed: int, needs: tuple[str, ...] = (), **params: Any) -> JobSpec:
        params["bench"] = self.bench.model_dump(mode="json")
        return JobSpec(kind, params, seed, needs, self.code)

    @staticmethod
    def _cell(piece: str, bottom: str) -> int:
        return 10 * PIECES.index(piece) + BOTTOMS.index(bottom)


def paper_training(inputs: str, epochs: int) -> TrainingSettings:
    """Return training as the paper may have done it: a constant rate, and the last weights.

    The paper names neither a schedule nor an early stop.
    """
    return TrainingSettings.model_validate(
        {
            "modality": inputs,
            "epochs": epochs,
            "schedule": "constant",
            "keep": "last",
            "patience": epochs,
            # One mounting an outline: nothing is chosen by validation, so that it may know them.
            "divide_series": True,
        }
    )
