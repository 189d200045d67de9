"""Simulated bench of one scene without cameras, for plans that use no images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.config import Limits, ProbeSettings, SimulationSettings, StackSettings
from touchdown.backend.core import FINGERS, Event, FloatArray
from touchdown.backend.devices import Arm
from touchdown.backend.runs import Bench, Plan, SceneChoice
from touchdown.backend.simulation.conditions import true_offset_mm
from touchdown.backend.simulation.gripper import HeldPiece

# Short ways: a touch takes less than a second of the bench's time.
BRISK = StackSettings(probe=ProbeSettings(start_height_mm=1.0, travel_mm_s=50.0, approach_mm_s=4.0))
STEP_US = 20_000


class BlindBench:
    """One scene with the piece in its jig; ``run`` runs a plan to its end."""

    def __init__(
        self,
        choice: SceneChoice,
        preset: str = "mixed",
        changes: Mapping[str, object] = MappingProxyType({}),
        arm: Callable[[Arm], Arm] = lambda arm: arm,
    ) -> None:
        """``arm`` returns a replacement of the simulated arm."""
        given = {"preset": preset, "cycle_us": STEP_US, **changes}
        settings = SimulationSettings.model_validate(given)
        session = simulated_session(SimulatedBenchChoice(given=settings), method=BRISK)
        self._session, self.interlock = session, session.interlock
        self.interlock.limits = Limits(contact_speed_mm_s=4.0).model_copy(
            update={"frame_age_s": 1e6}
        )
        self.facts: list[Event] = []
        session.events.subscribe(self.facts.append)
        make = session._make_stage

        def blind(choice, raw):
            stage = make(replace(choice, jig=True, estimates=False), raw)
            self.simulated = stage.scoring.bench
            return replace(stage, arm=arm(stage.arm), scoring=None)

        session._make_stage = blind
        self.bench: Bench = session._set_scene(choice)
        for finger in FINGERS:
            # No picture is drawn that nobody looks at.
            session.devices[f"tactile_{finger}"].close()
        self.centres_mm: list[FloatArray] = []
        """Per grip, where the hand truly has to be for the face to lie over the bottom's centre."""
        self._held: HeldPiece | None = None
        self._advance()

    def run(self, plan: Callable[[Bench], Plan[object]]) -> object:
        """Return the value of ``plan``; raises the error that ended it."""
        self.interlock.renew_lease(self.bench.now_s())
        return self._session.engine.run(plan(self.bench), self._advance)

    def _advance(self) -> None:
        self._session.advance()
        holding = self.simulated._world.holding
        if holding is not None and holding is not self._held:
            still = replace(holding.conditions, label_error_mm=np.zeros((1, 2)))
            self.centres_mm.append(-true_offset_mm(np.zeros((1, 2)), still)[0])
        self._held = holding
