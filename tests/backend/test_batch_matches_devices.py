"""Mass simulation and the device path (render -> track -> episode) show the model the same thing.

Sensor noise is off, the mechanical draws are equal; what differs is everything else: 10 ms cycles
against vectorised presses, rendered images against computed fields, the tracker, the synchroniser.
"""

from __future__ import annotations

import numpy as np
import pytest

from backend.config.method import StackSettings
from backend.config.simulation import SimulationSettings
from backend.core.facts import EpisodeRecorded, TrialStarted
from backend.core.flow import TACTILE_CHANNELS
from backend.objects.catalogue import load_catalogue
from backend.objects.surface import face_points
from backend.simulation import episodes, holding, nuisance
from tests.backend.runs.oracle_bench import OracleSession, request

RMS_LIMIT_PX = 0.15
MOUNTING = nuisance.Mounting((0.003, -0.004), (0.1, -0.05), 20.0)
GRIPPING = nuisance.Gripping(0.92, 0.8, 10.2, (0.4, -0.3), 0.015, (1.03, 0.97))
PROBE = nuisance.ProbeDraw(0.43, (0.0, 0.0), np.zeros((2, 2)), np.zeros(6))
ONE_PROBE = StackSettings().model_copy(
    update={"policy": StackSettings().policy.model_copy(update={"max_probes": 1})}
)


@pytest.mark.parametrize(
    ("piece", "bottom", "seed"),
    [("pot", "short", 1), ("pot", "long", 2), ("barrel", "rect12x28", 3), ("mushroom", "short", 4)],
)
def test_one_press_felt_by_the_devices_is_the_one_simulated_in_bulk(
    piece: str, bottom: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (holding, nuisance):
        monkeypatch.setattr(module, "draw_mounting", lambda *_: MOUNTING)
        monkeypatch.setattr(module, "draw_gripping", lambda *_: GRIPPING)
        monkeypatch.setattr(module, "draw_probe", lambda *_: PROBE)
    felt = OracleSession(preset="off", method=ONE_PROBE)
    felt.session.run(request(piece=piece, bottoms=(bottom,), seed=seed))
    recorded = felt.of(EpisodeRecorded)[0]
    started = felt.of(TrialStarted)[0]
    assert isinstance(recorded, EpisodeRecorded)
    assert isinstance(started, TrialStarted)
    commanded = recorded.episode.offset_mm

    monkeypatch.setattr(episodes._Bench, "_draw_offset", lambda *_: np.array(commanded))
    catalogue = load_catalogue()
    top, below = catalogue.top(piece), catalogue.bottom(bottom)
    assert top.grip_height_mm is not None
    plan = episodes.Plan(
        piece=piece,
        bottom=bottom,
        face=top.face,
        bottom_outline=below.face,
        face_points_mm=face_points(top.face),
        grip_height_mm=top.grip_height_mm,
        width_mm=top.width_mm,
        episodes=1,
        seed=seed,
        settings=SimulationSettings.model_validate({"preset": "off"}),
    )
    batch = next(iter(episodes.simulate(plan)))
    assert batch.true_offset_mm[0] == pytest.approx(started.start_mm, abs=0.05)

    difference = recorded.episode.observation - batch.observation[0]
    rms_px = float(np.sqrt(np.mean(difference[:, :TACTILE_CHANNELS] ** 2)))
    moved_px = float(np.sqrt(np.mean(batch.observation[0][:, :TACTILE_CHANNELS] ** 2)))
    assert moved_px > 2.0
    assert rms_px <= RMS_LIMIT_PX
    wrench = np.abs(difference[:, TACTILE_CHANNELS:])
    assert wrench[:, :3].max() < 0.15
    assert wrench[:, 3:].max() < 0.01
