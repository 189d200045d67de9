"""A session whose estimator knows the truth: what remains to fail is loop, bench and sensing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from backend import assembly
from backend.config.method import StackSettings
from backend.config.simulation import SimulationSettings
from backend.core.facts import Fact
from backend.core.flow import ContactPatch, Episode
from backend.devices.sim.bench import BenchStreams, SimulatedBench
from backend.objects.catalogue import Piece, load_catalogue
from backend.objects.surface import face_points, true_patch
from backend.runs.fact_codec import encode
from backend.runs.requests import SceneChoice, StackRequest
from backend.runs.stage import Stage
from backend.sensing.live import RawStreams
from backend.sensing.tare import gripper_payload
from backend.session import Keep, Session
from backend.simulation.disturbances import parse_script


class Oracle:
    """Answers with the true patch, 95 % sure of every point."""

    base_rate = None

    def __init__(self, bench: SimulatedBench, piece: Piece) -> None:
        self._bench, self._points = bench, face_points(piece.face)
        self.asked: list[Episode] = []

    def prepare(self, early: np.ndarray) -> None:
        """Nothing to prepare."""

    def estimate(self, episode: Episode) -> ContactPatch:
        assert np.isfinite(episode.observation).all()
        self.asked.append(episode)
        offset = np.array(self._bench.truth().offset_mm)
        patch = true_patch(self._points, offset, self._bench.scene.surface)
        return ContactPatch(self._points.copy(), np.where(patch, 0.95, 0.05))


class OracleSession:
    """One session with its facts and its benches."""

    def __init__(
        self,
        *faults: str,
        preset: str = "mixed",
        runs: Path | None = None,
        method: StackSettings | None = None,
    ) -> None:
        self.benches: list[SimulatedBench] = []
        self.oracles: list[Oracle] = []
        self.facts: list[Fact] = []
        self._script = parse_script(faults)
        self._settings = SimulationSettings.model_validate({"preset": preset})
        self._catalogue = load_catalogue()
        self.session = Session(
            self._make_stage,
            lambda _: {},
            self._catalogue,
            settings=method or StackSettings(),
            keep=Keep(runs),
            simulated=True,
        )
        self.session.hub.subscribe(self.facts.append)

    def _make_stage(self, choice: SceneChoice, raw: RawStreams) -> Stage:
        scene = assembly.make_scene(self._catalogue, choice, self._settings)
        streams = BenchStreams(raw.frames, raw.samples, raw.poses)
        bench = SimulatedBench(scene, self._script, streams)
        oracle = Oracle(bench, scene.piece)
        self.benches.append(bench)
        self.oracles.append(oracle)
        wrist = self._settings.wrist
        return Stage(
            clock=bench.clock,
            devices=bench.devices,
            arm=bench.arm,
            gripper=bench.gripper,
            piece=scene.piece,
            bottom="+".join(choice.bottoms),
            advance=bench.advance,
            scoring=assembly.SimulatedScoring(bench, 3.0, animate=False),
            estimator=oracle,
            payload=gripper_payload(wrist.payload_kg, wrist.payload_com_mm),
        )

    def of(self, kind: type[Fact]) -> list[Fact]:
        return [fact for fact in self.facts if isinstance(fact, kind)]

    def record(self) -> list[dict[str, object]]:
        """Return all facts as plain data, without what a wall clock or a run name decides."""
        lines = []
        for fact in self.facts:
            line = encode(fact)
            for key in ("latency_ms", "run_id"):
                line.pop(key, None)
            lines.append(line)
        return lines


def request(**changes: object) -> StackRequest:
    return replace(StackRequest(piece="pot", bottoms=("short",), seed=7), **changes)
