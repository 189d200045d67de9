"""Cost of the same error in every frame of a real window, beside the same window without it.

As a program it is that window, with a run on the simulated bench and its log in a file; it prints
what it measured as JSON. Slices with and without the error take turns.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from tests.bench.children.failing_window import print_found
from tests.bench.children.window_slices import RATES, Slice, Sliced, together
from tests.bench.raised_errors import Canvas
from tests.bench.registry import Figure, figure
from tests.bench.workers import hooked, window
from touchdown.app.shell.cards import exit_after_timeout
from touchdown.app.shell.errors import log_to
from touchdown.app.start import THREAD_SWITCH_S
from touchdown.backend.core.events import FaultRaised
from touchdown.backend.core.faults import Fault

# 60 s with the error and 60 s without, for each kind; the error is written every 5 s
SLICE_S, TURNS, LIMIT_S = 5.0, 12, 600.0
MOST_PERCENT, MOST_GAP_MS, LEAST_KEPT = 30.0, 100.0, 0.9
MOST_BYTES = 10_000_000
FLOOD = Fault("FLOOD", "The same fault in every step of the bench.", "None.", "Reset.")


class Flood:
    """``kind`` names which error comes in every frame; "" for none."""

    def __init__(self, window: Sliced) -> None:
        self.kind, self._hub, self._clock_s = "", window.session.events, window.session.clock_s
        self.canvas = Canvas(window.main.window)
        self.canvas.resize(40, 40)
        self.canvas.show()
        window.main.pump.add(self._view)
        window.main.pump.add(self._paint)
        self._step = window.session.advance
        window.session.advance = self._advance  # type: ignore[method-assign]
        self.raised = dict.fromkeys(KINDS, 0)

    def _view(self) -> None:
        if self.kind == "view":
            self.raised["view"] += 1
            raise RuntimeError("as was wanted")

    def _paint(self) -> None:
        self.canvas.raising = self.kind == "paint event"
        self.raised["paint event"] += self.canvas.raising
        self.canvas.update()

    def _advance(self) -> None:
        self._step()
        if self.kind == "bench":
            self.raised["bench"] += 1
            self._hub.publish(FaultRaised(self._clock_s(), FLOOD))


# view that fails to draw, widget that fails to paint, fault in every step
KINDS = ("view", "paint event", "bench")


@figure("faults")
def window_beside_the_same_error_in_every_frame() -> list[Figure]:
    """Share of a core, frame rates and longest gap of the window, with the error and without."""
    with hooked() as environment:
        found = window(environment, module=__name__, limit_s=LIMIT_S)
    if "named" in found:
        return [Figure("window beside a flood", None, "", "alive", ok=False, note=f"{found}")]
    kinds: Mapping[str, Mapping[str, Mapping[str, float]]] = found["kinds"]  # type: ignore[assignment]
    rates = {kind: min(one["with"][name] / one["without"][name] for name in RATES)
             for kind, one in kinds.items()}  # fmt: skip
    log_bytes, kept = float(found["log_bytes"]), min(rates.values())
    return [
        _worst(kinds, "core_percent", "window's share of a core", "%", MOST_PERCENT),
        _worst(kinds, "gap_ms", "longest gap of the window's ticks", "ms", MOST_GAP_MS),
        Figure("error in every frame: frame rates kept, worst of three views", kept, "of 1",
               f">= {LEAST_KEPT:g}", kept >= LEAST_KEPT,
               _told(kinds, lambda one: "/".join(f"{one[name]:.1f}" for name in RATES))),
        Figure("error in every frame: log", log_bytes / 1e3, "kB", "<= 10,000",
               log_bytes <= MOST_BYTES, f"errors: {found['raised']}"),
    ]  # fmt: skip


def _worst(
    kinds: Mapping[str, Mapping[str, Mapping[str, float]]], key: str, name: str, unit: str,
    most: float,
) -> Figure:  # fmt: skip
    value = max(one["with"][key] for one in kinds.values())
    note = _told(kinds, lambda one: f"{one[key]:.1f}")
    return Figure(f"error in every frame: {name}, worst", value, unit, f"<= {most:g}",
                  value <= most, note)  # fmt: skip


def _told(
    kinds: Mapping[str, Mapping[str, Mapping[str, float]]],
    words: Callable[[Mapping[str, float]], str],
) -> str:
    """Return for each kind the results with and without the error."""
    return "; ".join(f"{kind} {words(one['with'])}, without {words(one['without'])}"
                     for kind, one in kinds.items())  # fmt: skip


def main() -> int:
    """Print what was measured."""
    sys.setswitchinterval(THREAD_SWITCH_S)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "log"
        assert log_to(folder) is not None
        window = Sliced(Path(name))
        window.stack()
        flood, kinds = Flood(window), dict[str, dict[str, object]]()
        for kind in KINDS:
            slices: dict[str, list[Slice]] = {"with": [], "without": []}
            for _ in range(TURNS):
                for which, raised in (("without", ""), ("with", kind)):
                    flood.kind = raised
                    slices[which].append(window.slice_of(SLICE_S))
            flood.kind = ""
            kinds[kind] = {which: together(some) for which, some in slices.items()}
            window.main.cards.clear()
        log_bytes = sum(path.stat().st_size for path in folder.iterdir())
        window.close()
        found = {"kinds": kinds, "raised": flood.raised, "log_bytes": log_bytes}
        print_found(found)
    exit_after_timeout()
    return 0


if __name__ == "__main__":
    sys.exit(main())
