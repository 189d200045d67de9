"""Fixture that makes the window draw everything at the next tick, on any computer.

The pump defers views that exceed its time budget, and presenters draw a few times per second. A
test of the window must not depend on either. A test of the pace itself is marked ``usual_pace``.
"""

import importlib
from collections.abc import Iterator

import pytest

from touchdown.widgets.base.freshness import EventPump

# modules of the window with their drawing period
PACES = {
    "touchdown.app.calibrate.presenter": "PERIOD_S",
    "touchdown.app.shell.top_bar": "PERIOD_S",
    "touchdown.app.collect.presenter": "GAUGE_S",
    "touchdown.app.connect.presenter": "PERIOD_S",
    "touchdown.app.shell.live": "HEADER_PERIOD_S",
    "touchdown.app.operate.jogging": "PERIOD_S",
}


@pytest.fixture(autouse=True)
def prompt(request: pytest.FixtureRequest) -> Iterator[None]:
    """Remove waits for the wall clock, except in tests marked ``usual_pace``."""
    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("usual_pace") is None:
            patch.setitem(EventPump.__init__.__kwdefaults__, "budget_s", float("inf"))
            for module, name in PACES.items():
                patch.setattr(importlib.import_module(module), name, 0.0)
        yield
