"""Each button of the form of a campaign asks for what is written on it."""

from dataclasses import fields

import pytest

from touchdown.widgets.base.theme import Theme, load_resources
from touchdown.widgets.forms.collect_form import TargetButtons, TargetPanel

BUTTONS = {
    "start": "start",
    "go_on": "go_on",
    "pause": "pause",
    "end": "end",
    "take": "take_origin",
    "here": "origin_here",
    "lift": "lift",
}


@pytest.fixture
def asked():
    return []


@pytest.fixture
def panel(qapp, qtbot, asked):
    load_resources()
    theme = Theme()
    theme.apply(qapp, "light", 1.0)

    def intent(name):
        return lambda *_: asked.append(name)

    made = TargetPanel(
        theme, TargetIntents(**{f.name: intent(f.name) for f in fields(TargetIntents)})
    )
    qtbot.addWidget(made)
    made.show_buttons(TargetButtons(start=True, pause=True, end=True, paused=False, go_on="3 left"))
    made.show_residual("0.4 mm", usable=True)
    return made


@pytest.mark.parametrize(("button", "intent"), BUTTONS.items())
def test_a_button_asks_for_its_own_intent_alone(panel, asked, button, intent):
    getattr(panel, button).click()
    assert asked == [intent]
