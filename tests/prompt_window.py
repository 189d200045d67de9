"""A window that shows at the next turn whatever is to be shown, on any computer.

The pump puts off what does not fit into its budget of the wall clock, and presenters draw a few
times a second of it: a slow computer is late with what a test looks at, a quick one is done before
it is due. Neither is what a test of the window is about, so here nothing is put off and everything
is due. A test of the pace itself asks for it by ``usual_pace``.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator

import pytest

from touchdown.widgets.base.freshness import EventPump

PACES = {
    "touchdown.app.calibrate.presenter": "PERIOD_S",
    "touchdown.app.shell.top_bar": "PERIOD_S",
    "touchdown.app.collect.presenter": "GAUGE_S",
    "touchdown.app.connect.presenter": "PERIOD_S",
    "touchdown.app.shell.live": "HEADER_PERIOD_S",
    "touchdown.app.operate.jogging": "PERIOD_S",
}
"""Modules of the window and what says there how often something is drawn."""


@pytest.fixture(autouse=True)
def prompt(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let nothing wait for the wall clock, but in tests marked ``usual_pace``."""
    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("usual_pace") is None:
            patch.setitem(EventPump.__init__.__kwdefaults__, "budget_s", float("inf"))
            for module, name in PACES.items():
                patch.setattr(importlib.import_module(module), name, 0.0)
        yield
