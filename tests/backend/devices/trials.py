"""What one trial of a fault campaign hands back, whatever the device."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Ended:
    """What was done, what went wrong, and which rows do not hold."""

    seed: int
    doing: str
    fault: str
    broken: tuple[str, ...]
