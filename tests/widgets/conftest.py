"""Fixtures of the widgets."""

import pytest

from touchdown.widgets.base.theme import THEMES, Theme, load_resources


@pytest.fixture(params=THEMES)
def theme(qapp, request):
    load_resources()
    made = Theme()
    made.apply(qapp, request.param, 1.0)
    return made
