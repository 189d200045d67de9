"""A command to the gripper in progress: the requests it takes, one after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from backend.devices.motion import CommandedMotion
from backend.wire.wsg_binary import Request


class WsgMotion(CommandedMotion):
    """The step under way is the first of ``steps``; ``pending`` once the gripper accepted it."""

    def __init__(
        self, steps: Sequence[Request], sent: Mapping[str, float], deadline_s: float
    ) -> None:
        super().__init__(sent)
        self.steps, self.deadline_s = list(steps), deadline_s
        self.pending = self.resent = False
