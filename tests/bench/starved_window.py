"""Frame rates of a real window beside a training that runs out of memory or is killed.

As a program it is that window, with a run on the simulated bench; it prints what it measured as
JSON: slices before any training, beside one, while it dies, and after it.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from tests.bench.children.failing_window import print_found
from tests.bench.children.window_slices import RATES, Sliced, together
from tests.bench.registry import Figure, figure
from tests.bench.workers import MEMORY_FAILURES, hooked, window
from touchdown.app.shell.cards import exit_after_timeout
from touchdown.app.start import THREAD_SWITCH_S

SLICE_S = 5.0
LEAST_KEPT, MOST_GAP_MS = 0.9, 100.0
WHENS = ("before", "beside", "dying", "after")
# larger than the shipped models, so that the training outlasts the measurement
SIZES = {"hidden": 512, "layers": 2, "batch": 1}
TOLD = "TRAINING-DIED"


@figure("faults")
def window_beside_a_training_without_memory() -> list[Figure]:
    """Frame rates and longest gap before, beside and after it, and while it dies."""
    with hooked() as environment:
        found = window(environment, module=__name__)
    if "named" in found:
        name = "window beside a training that dies"
        return [Figure(name, None, "", "alive", ok=False, note=f"{found}")]
    ways: Mapping[str, Mapping[str, Mapping[str, float]]] = found["ways"]  # type: ignore[assignment]
    # The window alone, before and after: both include the other load of the machine.
    alone = {way: {name: (one["before"][name] + one["after"][name]) / 2.0 for name in RATES}
             for way, one in ways.items()}  # fmt: skip
    kept = min(one[when][name] / alone[way][name] for way, one in ways.items()
               for when in ("beside", "dying") for name in RATES)  # fmt: skip
    gap_ms = max(one[when]["gap_ms"] for one in ways.values() for when in ("beside", "dying"))
    rates = "; ".join(
        f"{way}: " + ", ".join(f"{when} " + "/".join(f"{one[when][name]:.1f}" for name in RATES)
                               for when in WHENS) for way, one in ways.items()
    )  # fmt: skip
    gaps = "; ".join(f"{way}: " + ", ".join(f"{when} {one[when]['gap_ms']:.0f}" for when in WHENS)
                     for way, one in ways.items())  # fmt: skip
    return [
        Figure("training that dies: frame rates kept, worst of three views", kept, "of 1",
               f">= {LEAST_KEPT:g}", kept >= LEAST_KEPT, rates),
        Figure("training that dies: longest gap of the window's ticks", gap_ms, "ms",
               f"<= {MOST_GAP_MS:g}", gap_ms <= MOST_GAP_MS, gaps),
    ]  # fmt: skip


def measured(window: Sliced) -> dict[str, dict[str, object]]:
    """Let a training die in each way."""
    found = dict[str, dict[str, object]]()
    train = window.train()
    for name, value in SIZES.items():
        getattr(train.page.form.numbers, name).setValue(value)
    window.stack()
    for way, strike in MEMORY_FAILURES.items():
        whens = {"before": window.slice_of(SLICE_S)}
        window.main.go("train")
        number = window.begin(train)
        window.main.go("stack")
        whens["beside"] = window.slice_of(SLICE_S)
        strike(number)
        whens["dying"] = window.slice_of(SLICE_S)
        assert TOLD in window.main.cards.codes, window.main.cards.codes
        window.main.cards.clear((TOLD,))
        whens["after"] = window.slice_of(SLICE_S)
        found[way] = {when: together([one]) for when, one in whens.items()}
    return found


def main() -> int:
    """Print what was measured."""
    sys.setswitchinterval(THREAD_SWITCH_S)
    with tempfile.TemporaryDirectory() as name:
        os.environ["TOUCHDOWN_DATA"] = name
        window = Sliced(Path(name))
        found = measured(window)
        window.close()
        print_found({"ways": found})
    exit_after_timeout()
    return 0


if __name__ == "__main__":
    sys.exit(main())
