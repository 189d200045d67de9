"""What a session gives to the plan of one request."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from backend.catalogue.dataset import Dataset
from backend.config.bench_facts import BenchFacts
from backend.config.method import StackSettings
from backend.objects.catalogue import Piece
from backend.runs.bench import Bench
from backend.runs.gate import Decisions
from backend.runs.requests import SceneChoice


@dataclass(frozen=True, slots=True)
class RunHost:
    """A bench to be set and used. All calls come from the plan, on the bench's own time.

    ``check`` raises ``InputError`` for a scene that cannot be set, else returns what a run on it
    depends on beside request and method, JSON-ready. ``open`` begins journal and episode store.
    ``set_scene`` builds the scene anew, its clock starts at zero; ``present`` takes it as it is
    (``RefusedError`` if there is none yet). Episode files keep ``mode`` and ``facts``;
    ``dataset`` takes what is collected, ``decisions`` says which of it to keep; ``piece`` knows
    pieces by name.
    """

    run_id: str
    simulated: bool
    mode: str
    facts: BenchFacts
    dataset: Dataset | None
    decisions: Decisions
    piece: Callable[[str], Piece]
    method: StackSettings
    check: Callable[[SceneChoice], Mapping[str, object]]
    open: Callable[[], None]
    set_scene: Callable[[SceneChoice, StackSettings], Bench]
    present: Callable[[StackSettings], Bench]
