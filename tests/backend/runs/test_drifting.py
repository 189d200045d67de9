"""A change of the wrench counts as drift with a level hand at rest in air and a constant load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import EpisodeRecorded, Noticed
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import FINGERS, Pose
from touchdown.backend.devices.protocols import GripStatus
from touchdown.backend.runs.calibrations import DriftMonitor, DriftScene
from touchdown.backend.runs.requests import ProbeRequest, SceneChoice
from touchdown.backend.sensing.live import LiveSensing, RawStreams

SURFACE_MM = 30.0


class Bench:
    """Hand and 100 Hz wrist sensor with a given force creep."""

    def __init__(self) -> None:
        frames = {finger: Stream(f"tactile_{finger}", 4) for finger in FINGERS}
        raw = RawStreams(frames, SampleStream("force_torque", 6, 4000), SampleStream("arm", 3, 10))
        fields = {finger: Stream(f"markers_{finger}", 4) for finger in FINGERS}
        self.sensing = LiveSensing(raw, fields, SampleStream("wrench", 6, 4000), np.zeros(6))
        self.now_s, self.force_n, self.told = 0.0, -15.0, list[Noticed]()
        self.at, self.grip = Pose(0.0, 0.0, SURFACE_MM + 3.0), GripStatus(24.0, 10.0, True)
        self._rng = np.random.default_rng(3)
        place = DriftScene(lambda: self.now_s, self, self, lambda: SURFACE_MM)  # type: ignore[arg-type]
        self._teller = DriftMonitor(place, self.sensing, self.told.append)  # type: ignore[arg-type]

    def pose(self, _max_age_s: float) -> Pose:
        return self.at

    def status(self) -> GripStatus:
        return self.grip

    def go(self, seconds: float, n_per_s: float = 0.0, turn_rad_s: float = 0.0) -> None:
        for _ in range(round(10 * seconds)):
            t_s = self.now_s + np.arange(1, 11) * 0.01
            self.now_s += 0.1
            self.force_n += 0.1 * n_per_s
            self.at = replace(self.at, rx_rad=self.at.rx_rad + 0.1 * turn_rad_s)
            wrench = 0.1 * self._rng.standard_normal((10, 6))
            wrench[:, 2] += self.force_n
            self.sensing.raw.samples.put(t_s, wrench)
            self._teller.update()


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.go(8.0)
    assert made.sensing.drift.moved_n < 0.1
    return made


def test_a_drift_in_still_air_is_told_once_before_it_reaches_1_n(bench: Bench) -> None:
    bench.go(18.0, 0.05)
    (told,) = bench.told
    assert told.fault.code == "FT-DRIFT"
    assert 0.45 < 0.05 * (told.t_s - 8.0) < 0.8
    assert "Zero it in air (Z)" in told.text


@pytest.mark.promise("S8")
def test_what_creeps_in_contact_is_no_drift_however_long(bench: Bench) -> None:
    bench.at = replace(bench.at, z_mm=SURFACE_MM + 0.2)
    bench.force_n += 8.0
    bench.go(40.0, -0.05)
    bench.at = replace(bench.at, z_mm=SURFACE_MM + 3.0)
    bench.force_n = -15.0
    bench.go(3.0)
    assert bench.told == []
    assert bench.sensing.drift.moved_n < 0.1


def test_a_hand_that_turns_or_takes_another_piece_begins_anew(bench: Bench) -> None:
    bench.go(10.0, 0.1, turn_rad_s=0.01)
    bench.at = replace(bench.at, rx_rad=0.0)
    bench.go(3.0)
    bench.force_n += 1.0
    bench.grip = GripStatus(float("nan"), 0.0, False)
    bench.go(3.0)
    bench.force_n -= 0.2
    bench.grip = GripStatus(18.0, 10.0, True)
    bench.go(3.0)
    assert bench.told == []
    assert bench.sensing.drift.moved_n < 0.15


def test_the_simulated_sensor_drifts_on_demand_and_its_probe_keeps_how_far() -> None:
    session = simulated_session(
        brisk_bench("quiet", faults=("force_torque:drift=0.09@0.5",)), method=brisk_method()
    )
    told, episodes = list[Noticed](), list[EpisodeRecorded]()
    session.events.subscribe(lambda f: told.append(f) if isinstance(f, Noticed) else None)
    session.events.subscribe(
        lambda f: episodes.append(f) if isinstance(f, EpisodeRecorded) else None
    )
    session.prepare(SceneChoice("pot", ("short",)))
    while session.clock_s() < 9.0 and not told:
        session.advance()
    assert 0.45 < 0.09 * (told[0].t_s - 0.5) < 0.8
    session.run(ProbeRequest())
    assert dict(episodes[0].episode.metadata)["wrist_drift"].endswith(" s")
    assert len(told) == 1
    session.close()
