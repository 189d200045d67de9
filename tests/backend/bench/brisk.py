"""Simulated bench with the same course of events at a quarter of the cost.

The course of a run depends neither on the image rate nor on the ways through the air: half the
images, cycles of one step of the session, and short free moves at the highest speed that the
interlock allows. Recordings themselves are tested with the default settings.
"""

from __future__ import annotations

from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.config.method import (
    CollectSettings,
    ProbeSettings,
    ReleaseSettings,
    StackSettings,
)
from touchdown.backend.config.simulation import SimulationSettings

# Pictures a second and finger: still one in every 0.1 s between two ticks of a probe.
RATE_HZ = 12.5
CYCLE_US = 20_000
PROBE = ProbeSettings(travel_mm_s=50.0, start_height_mm=1.5, reference_frames=4)
RELEASE = ReleaseSettings(open_mm_s=20.0, rise_mm=5.0)


def brisk_method(**limits: object) -> StackSettings:
    """Return the method with fast free moves; ``limits`` are those of collecting."""
    collect = CollectSettings.model_validate({"open_mm": 4.0, **limits})
    return StackSettings(probe=PROBE, release=RELEASE, collect=collect)


def brisk_settings(preset: str = "mixed", rate_hz: float = RATE_HZ) -> SimulationSettings:
    """Return the settings of ``preset`` with a lower image rate.

    No image is dropped or late: at this rate a single one would leave a gap.
    """
    tactile = {"rate_hz": rate_hz, "drop_share": 0.0, "jitter_s": 0.0}
    given = {"preset": preset, "cycle_us": CYCLE_US, "tactile": tactile}
    return SimulationSettings.model_validate(given)


def on(session, kind, act) -> None:
    """Call ``act`` with each event of ``kind``."""
    session.events.subscribe(lambda event: act(event) if isinstance(event, kind) else None)


def brisk_bench(
    preset: str = "mixed", rate_hz: float = RATE_HZ, faults: tuple[str, ...] = ()
) -> SimulatedBenchChoice:
    """Return the choice of a bench with ``brisk_settings`` and faults."""
    return SimulatedBenchChoice(given=brisk_settings(preset, rate_hz), disturbances=faults)


def brisk_session(preset="quiet", faults=(), keep=None, method=None):
    """Return a session on a brisk bench; nothing is kept without ``keep``."""
    return simulated_session(
        brisk_bench(preset, faults=faults), keep=keep, method=method or brisk_method()
    )
