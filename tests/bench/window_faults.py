"""A real window while a camera blocks, code raises, a training dies or the catalogue is locked."""

import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tests.bench.children.faulty_window import FIRST_LABELS, HELD_S, LABELS
from tests.bench.children.watched_arm import watched_arm
from tests.bench.figures import Figure, at_least, at_most, figure
from tests.bench.labelling import fill
from tests.bench.workers import GONE_S, TOLD_S, hooked, window
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.core.faults import InputError

CHILD, LIMIT_S = "tests.bench.children.faulty_window", 600.0
RATES = ("left_fps", "right_fps", "traces_fps")
MOST_GAP_MS, MOST_PERCENT, LEAST_KEPT = 100.0, 30.0, 0.9
MOST_LINES_PER_S, MOST_LOG_BYTES = 5.0, 10_000_000
EPISODES = 30
Measured = Mapping[str, Mapping[str, float]]


def measured(*words: str, **environment: str) -> dict[str, Any]:
    """Run a scenario in a window of its own; raises InputError if the window did not survive."""
    with hooked() as hooks:
        found = window({**hooks, **environment}, *words, module=CHILD, limit_s=LIMIT_S)
    if "named" in found:
        raise InputError(f"The window ended early: {found['named']}.", words[0], "See its output.")
    return found | {"gone_s": time.monotonic()}


def _gap(name: str, gap_ms: float, note: str) -> Figure:
    return at_most(name, gap_ms, "ms", MOST_GAP_MS, note)


def _kept(name: str, share: float, note: str) -> Figure:
    text = f"{name}: frame rates kept, worst of three views"
    return at_least(text, share, "of 1", LEAST_KEPT, note)


def _rates(one: Mapping[str, float]) -> str:
    return "/".join(f"{one[name]:.1f}" for name in RATES)


@figure("faults")
def camera_that_blocks_beside_a_window() -> list[Figure]:
    """The longest gap of the window's ticks, and quitting while a read is blocked."""
    with watched_arm() as arm:
        found = measured("blocked camera", str(arm.lab))
    closed_s = found["gone_s"] - found["asked_s"]
    note = f"a read of 10 s; {found['usual_ms']:.0f} ms in 10 s before; cards {found['cards']}"
    return [
        _gap("longest gap of the window's ticks, camera blocked", found["blocked_ms"], note),
        at_most("window gone after quitting, camera blocked", closed_s, "s", GONE_S),
    ]  # fmt: skip


@figure("faults")
def exceptions_of_every_kind() -> list[Figure]:
    """In a slot, a timer, a paint event, a thread and a queued call: once, then at every tick."""
    kinds: Measured = measured("exceptions")["kinds"]
    told_s = max(one["told_s"] for one in kinds.values())
    lines = max(one["lines_per_s"] for one in kinds.values())
    times = ", ".join(f"{kind} {1e3 * one['told_s']:.0f} ms" for kind, one in kinds.items())
    loud = ", ".join(f"{kind} {one['lines_per_s']:.1f}" for kind, one in kinds.items())
    return [
        at_most("exception: its card is there after, worst", told_s, "s", TOLD_S, times),
        at_most("log of an exception at every tick", lines, "lines/s", MOST_LINES_PER_S, loud),
    ]  # fmt: skip


@figure("faults")
def window_beside_the_same_error_in_every_frame() -> list[Figure]:
    """Share of a core, frame rates and longest gap of the window, with the error and without."""
    found = measured("error in every frame")
    kinds: Mapping[str, Measured] = found["kinds"]

    def note(words: Callable[[Mapping[str, float]], str]) -> str:
        return "; ".join(f"{kind} {words(one['with'])}, without {words(one['without'])}"
                         for kind, one in kinds.items())  # fmt: skip

    def worst(key: str) -> tuple[float, str]:
        value = max(one["with"][key] for one in kinds.values())
        return value, note(lambda one: f"{one[key]:.1f}")

    percent, shares = worst("core_percent")
    kept = min(one["with"][name] / one["without"][name] for one in kinds.values() for name in RATES)
    log_bytes = found["log_bytes"]
    return [
        _kept("error in every frame", kept, note(_rates)),
        at_most("error in every frame: share of a core, worst", percent, "%", MOST_PERCENT, shares),
        _gap("error in every frame: longest gap, worst", *worst("gap_ms")),
        Figure("error in every frame: log", log_bytes / 1e3, "kB", "<= 10,000",
               log_bytes <= MOST_LOG_BYTES, f"errors: {found['raised']}"),
    ]  # fmt: skip


@figure("faults")
def window_beside_a_training_without_memory() -> list[Figure]:
    """Frame rates and longest gap before, beside and after it, and while it dies."""
    ways: Mapping[str, Measured] = measured("dying training")["ways"]
    kept, gap_ms, notes = 1.0, 0.0, list[str]()
    for way, whens in ways.items():
        # The window alone, before and after: both include the other load of the machine.
        alone = {name: (whens["before"][name] + whens["after"][name]) / 2.0 for name in RATES}
        for when in ("beside", "dying"):
            kept = min(kept, *(whens[when][name] / alone[name] for name in RATES))
            gap_ms = max(gap_ms, whens[when]["gap_ms"])
        rows = (f"{w} {_rates(one)}, gap {one['gap_ms']:.0f} ms" for w, one in whens.items())
        notes.append(f"{way}: {', '.join(rows)}")
    name = "training that dies: longest gap of the window's ticks"
    return [_kept("training that dies", kept, "; ".join(notes)), _gap(name, gap_ms, "")]


@figure("faults")
def labels_while_the_catalogue_is_locked() -> list[Figure]:
    """The longest gap of the window's ticks while labels wait, and how many of them were lost."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "dataset"
        fill(place, EPISODES, EPISODES)
        found = measured("locked catalogue", TOUCHDOWN_DATA=name)
        asked: Mapping[str, tuple[int, int]] = found["asked"]
        with Dataset.open(place, write=False) as dataset:
            heads = {uuid: dataset.labels.head(uuid) for uuid in asked}
    lost = [
        uuid for uuid, (x_um, y_um) in asked.items() if heads[uuid].state != "submitted"
        or (heads[uuid].label.x_um, heads[uuid].label.y_um) != (x_um, y_um)
    ]  # fmt: skip
    locked = found["locked"]
    note = "; ".join(
        f"{held_s} s {gap_ms:.0f} ms ({found['waited'][held_s]} waited), not locked "
        f"{found['free'][held_s]:.0f} ms" for held_s, gap_ms in locked.items()
    )  # fmt: skip
    all_asked = len(asked) == FIRST_LABELS + 2 * LABELS * len(HELD_S)
    return [
        _gap("catalogue locked: longest gap of the window's ticks", max(locked.values()), note),
        Figure("catalogue locked: labels of the Label page lost", len(lost), f"of {len(asked)}",
               "0", not lost and all_asked, ", ".join(lost)),
    ]  # fmt: skip
