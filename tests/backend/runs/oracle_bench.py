"""Session whose estimator knows the truth: tests the loop, the bench and the sensing alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.backend.bench.brisk import RATE_HZ, brisk_bench, brisk_method
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.config.method import StackSettings
from touchdown.backend.core import ContactPatch, Episode, Event
from touchdown.backend.geometry.outlines import face_points, true_patch
from touchdown.backend.runs import RecordingOptions, StackRequest
from touchdown.backend.runs.event_log import encode_event
from touchdown.backend.simulation.devices.bench import SimulatedBench


class Oracle:
    """Returns the true patch with a probability of 95 % at every point."""

    base_rate = None
    calibration = None

    def __init__(self, bench: SimulatedBench) -> None:
        self._bench, self._points = bench, face_points(bench.scene.piece.face)
        self.prepared: list[np.ndarray] = []
        self.asked: list[Episode] = []

    def prepare(self, early: np.ndarray) -> None:
        self.prepared.append(early)

    def estimate(self, episode: Episode) -> ContactPatch:
        assert np.isfinite(episode.observation).all()
        self.asked.append(episode)
        offset = np.array(self._bench.truth().offset_mm)
        patch = true_patch(self._points, offset, self._bench.scene.surface)
        return ContactPatch(self._points.copy(), np.where(patch, 0.95, 0.05))


class OracleSession:
    """One session with its events and its benches."""

    def __init__(
        self,
        *faults: str,
        preset: str = "mixed",
        runs: Path | None = None,
        method: StackSettings | None = None,
        rate_hz: float = RATE_HZ,
    ) -> None:
        self.benches: list[SimulatedBench] = []
        self.oracles: list[Oracle] = []
        self.facts: list[Event] = []
        self.session = simulated_session(
            brisk_bench(preset, rate_hz, faults),
            keep=RecordingOptions(runs),
            method=method or brisk_method(),
            estimate=self._oracle,
        )
        self.session.events.subscribe(self.facts.append)

    def _oracle(self, bench: SimulatedBench) -> Oracle:
        self.benches.append(bench)
        self.oracles.append(Oracle(bench))
        return self.oracles[-1]

    def of(self, kind: type[Event]) -> list[Event]:
        return [fact for fact in self.facts if isinstance(fact, kind)]

    def record(self) -> list[dict[str, object]]:
        """Return all events as plain data, without wall times and run ids."""
        lines = []
        for fact in self.facts:
            line = encode_event(fact)
            for key in ("latency_ms", "run_id"):
                line.pop(key, None)
            lines.append(line)
        return lines


def request(**changes: object) -> StackRequest:
    return replace(StackRequest(piece="pot", bottoms=("short",), seed=10), **changes)
