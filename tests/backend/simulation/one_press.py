"""One press on the devices (render, track, episode) and the same press in the batch simulation.

Sensor noise is off and the mechanical draws are equal. The rest differs: 10 ms cycles and
vectorised presses, rendered images and computed fields, the tracker, the synchroniser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from tests.backend.runs.oracle_bench import OracleSession, request
from touchdown.backend.config import SimulationSettings, StackSettings
from touchdown.backend.core import TACTILE_CHANNELS, EpisodeRecorded, FloatArray, TrialStarted
from touchdown.backend.geometry import face_points, load_pieces
from touchdown.backend.simulation import batch as episodes
from touchdown.backend.simulation import conditions

RMS_LIMIT_PX = 0.15
# Piece, bottom, seed.
CASES = (
    ("pot", "short", 1),
    ("pot", "long", 2),
    ("barrel", "rect12x28", 3),
    ("mushroom", "short", 4),
)
MOUNTING = conditions.MountingDraw((0.003, -0.004), (0.1, -0.05), 20.0)
GRIPPING = conditions.GripDraw(0.92, 0.8, 10.2, (0.4, -0.3), 0.015, (1.03, 0.97))
PROBE = conditions.ProbeDraw(0.43, (0.0, 0.0), np.zeros((2, 2)), np.zeros(6))
ONE_PROBE = StackSettings().model_copy(
    update={"policy": StackSettings().policy.model_copy(update={"max_probes": 1})}
)


@dataclass(frozen=True)
class OnePress:
    """Observations (20, 258) and true start offsets (mm) of the two paths."""

    felt: FloatArray
    computed: FloatArray
    felt_mm: tuple[float, float]
    computed_mm: FloatArray

    @property
    def rms_px(self) -> float:
        """Difference of the marker displacements over the whole press."""
        tactile = (self.felt - self.computed)[:, :TACTILE_CHANNELS]
        return float(np.sqrt(np.mean(tactile**2)))


def press_both_ways(piece: str, bottom: str, seed: int, patch: pytest.MonkeyPatch) -> OnePress:
    """Press once on the devices and once in the batch, with equal mechanical draws."""
    patch.setattr(conditions, "draw_mounting", lambda *_: MOUNTING)
    patch.setattr(conditions, "draw_gripping", lambda *_: GRIPPING)
    patch.setattr(conditions, "draw_probe", lambda *_: PROBE)
    devices = OracleSession(preset="off", method=ONE_PROBE, rate_hz=25.0)
    devices.session.run(request(piece=piece, bottoms=(bottom,), seed=seed))
    recorded = devices.of(EpisodeRecorded)[0]
    started = devices.of(TrialStarted)[0]
    assert isinstance(recorded, EpisodeRecorded)
    assert isinstance(started, TrialStarted)
    assert started.start_mm is not None
    commanded = np.array(recorded.episode.offset_mm)
    patch.setattr(episodes._BatchBench, "_draw_offset", lambda *_: commanded)
    batch = next(iter(episodes.simulate_episodes(_plan(piece, bottom, seed))))
    return OnePress(
        recorded.episode.observation,
        batch.observation[0],
        started.start_mm,
        batch.true_offset_mm[0],
    )


def _plan(piece: str, bottom: str, seed: int) -> episodes.BatchPlan:
    catalogue = load_pieces()
    top = catalogue.top(piece)
    assert top.grip_height_mm is not None
    return episodes.BatchPlan(
        piece=piece,
        bottom=bottom,
        face=top.face,
        bottom_outline=catalogue.bottom(bottom).face,
        face_points_mm=face_points(top.face),
        grip_height_mm=top.grip_height_mm,
        width_mm=top.width_mm,
        episodes=1,
        seed=seed,
        settings=SimulationSettings.model_validate({"preset": "off"}),
    )
