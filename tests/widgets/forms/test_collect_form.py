"""Each button of the form of a campaign asks for what is written on it."""

import pytest

from touchdown.widgets.base.theme import Theme, load_resources
from touchdown.widgets.forms.collect_form import TargetButtons, TargetPanel

BUTTONS = {
    "start": "start_requested",
    "go_on": "resume_requested",
    "pause": "pause_requested",
    "end": "end_requested",
    "take": "residual_requested",
    "here": "origin_requested",
    "lift": "lift_requested",
}


@pytest.fixture
def asked():
    return []


@pytest.fixture
def panel(qapp, qtbot, asked):
    load_resources()
    theme = Theme()
    theme.apply(qapp, "light", 1.0)

    made = TargetPanel(theme)
    for name in BUTTONS.values():
        getattr(made, name).connect(lambda name=name: asked.append(name))
    qtbot.addWidget(made)
    made.show_buttons(TargetButtons(start=True, pause=True, end=True, paused=False, go_on="3 left"))
    made.show_residual("0.4 mm", usable=True)
    return made


@pytest.mark.parametrize(("button", "signal"), BUTTONS.items())
def test_a_button_emits_its_own_signal_alone(panel, asked, button, signal):
    getattr(panel, button).click()
    assert asked == [signal]
