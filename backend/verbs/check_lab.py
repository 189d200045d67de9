"""Doctor's look at a lab: its file, what is still made up in it, and each device."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from backend.verbs.check import Check

DEVICES = ("force_torque", "tactile_left", "tactile_right", "gripper", "arm")


def looks(path: Path) -> Iterator[Callable[[], Check]]:
    """Yield the looks at a lab file; raises ``InputError`` where it cannot be read."""
    from backend.config.lab import load_lab
    from backend.rig.examine import examine

    lab = load_lab(path)
    settings = lab.settings
    yield partial(Check, "lab file", True, f"{settings.name} ({settings.kind}), {path}")
    yield partial(_made_up, path)
    yield partial(_fingers, path)
    findings = examine(settings)
    for _ in DEVICES:
        yield partial(_next, findings)


def _made_up(path: Path) -> Check:
    from backend.config.lab import load_lab
    from backend.verbs.bench import placeholders

    settings = load_lab(path).settings
    names = placeholders(settings) if settings.kind == "hardware" else []
    if not names:
        return Check("made up", True, "nothing")
    return Check("made up", True, ", ".join(names), "Put in the lab's own numbers.")


def _fingers(path: Path) -> Check:
    from backend.config.lab import load_lab
    from backend.lab import otherwise_named

    told = otherwise_named(load_lab(path))
    if not told:
        return Check("cameras", True, "at the fingers that the lab file names, as far as is known")
    what, _, fix = next(iter(told.values())).partition(". ")
    return Check("cameras", True, what, f"{fix}.")


def _next(findings: Iterator[object]) -> Check:
    from backend.rig.examine import Finding

    found = next(findings)
    assert isinstance(found, Finding)
    return Check(found.device, found.ok, found.detail, found.fix)
