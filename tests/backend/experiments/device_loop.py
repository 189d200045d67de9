"""One run on the stepped bench with devices, rendering and tracker, for comparison."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from backend.assembly import SimulatedBenchChoice, simulated_session
from backend.config.simulation import SimulationSettings
from backend.core.facts import Fact
from backend.runs.requests import StackRequest
from backend.session import Keep


def run_on_devices(settings: SimulationSettings, request: StackRequest) -> list[Fact]:
    """Return the facts of the run on the bench ``settings``."""
    facts: list[Fact] = []
    with TemporaryDirectory() as folder:
        file = Path(folder) / "bench.toml"
        file.write_text(as_toml(settings))
        session = simulated_session(SimulatedBenchChoice(file=file), keep=Keep(None))
        session.hub.subscribe(facts.append)
        try:
            session.run(request)
        finally:
            session.close()
    return facts


def as_toml(settings: SimulationSettings) -> str:
    """Write settings as the TOML that the bench reads."""
    top, groups = [], []
    for key, value in settings.model_dump(mode="json").items():
        if isinstance(value, dict):
            lines = [f"{k} = {_text(v)}" for k, v in value.items() if v is not None]
            groups.append(f"[{key}]\n" + "\n".join(lines))
        else:
            top.append(f"{key} = {_text(value)}")
    return "\n".join(top + groups)


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, str) else str(value)
