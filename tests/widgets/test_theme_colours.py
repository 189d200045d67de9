"""Every token pair that is shown together can be read, with normal and with other colour vision."""

import re
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from PySide6.QtGui import QColor, QPalette
from PySide6.QtWidgets import QComboBox, QLineEdit, QListWidget, QProgressBar, QPushButton, QSpinBox

from touchdown.app import splash
from touchdown.widgets.base.theme import (
    CONTRAST,
    DARK,
    LIGHT,
    MAPS,
    load_resources,
    make_style_sheet,
)
from touchdown.widgets.plots.distribution import legible_colours
from touchdown.widgets.shell.devices import ChipState, mark_colours
from touchdown.widgets.views.belief import OUTLINES
from touchdown.widgets.views.offset import GHOST_STYLES
from touchdown.widgets.views.scene_camera import OUTLINE_STYLES
from touchdown.widgets.views.tactile import BIN_COLOURS

ROOT = Path(__file__).parents[2]
ARROWS_ON = "#14181C"
THEMES = [DARK, LIGHT, CONTRAST]
IDS = [t.name for t in THEMES]

# Machado, Oliveira, Fernandes 2009, severity 1, applied to linear RGB.
VISION = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                   [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                     [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                   [0.004733, 0.691367, 0.303900]],
}  # fmt: skip
TO_XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
                   [0.0193339, 0.1191920, 0.9503041]])  # fmt: skip
WHITE = np.array([0.95047, 1.0, 1.08883])


def contrast_ratio(one: QColor, other: QColor) -> float:
    """Contrast ratio of WCAG 2 (1 to 21) of two opaque colours."""
    darker, lighter = sorted((_luminance(one), _luminance(other)))
    return (lighter + 0.05) / (darker + 0.05)


def _linear(colour: QColor) -> np.ndarray:
    rgb = np.array([colour.redF(), colour.greenF(), colour.blueF()])
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def _luminance(colour: QColor) -> float:
    return float(_linear(colour) @ (0.2126, 0.7152, 0.0722))


def lab(colour: str, vision: str) -> np.ndarray:
    seen = np.clip(np.asarray(VISION[vision]) @ _linear(QColor(colour)), 0, 1)
    t = TO_XYZ @ seen / WHITE
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def smallest_distance(colours: list[str]) -> float:
    return min(
        float(np.linalg.norm(lab(a, vision) - lab(b, vision)))
        for vision in VISION
        for a, b in combinations(colours, 2)
    )


def ratio(tokens, one: str, other: str) -> float:
    return contrast_ratio(tokens.colour(one), tokens.colour(other))


def test_known_contrasts():
    assert contrast_ratio(QColor("#000000"), QColor("#ffffff")) == pytest.approx(21.0)
    assert contrast_ratio(QColor("#777777"), QColor("#ffffff")) == pytest.approx(4.48, abs=0.01)


INKS = ("axis_x", "axis_y", "axis_z")
PAIRS = [
    (("text", "muted"), ("bg", "panel", "raised", "hover"), 4.5),
    (INKS, ("bg", "panel"), 4.5),
    (("good", "bad"), ("panel", "bg", "raised", "hover"), 4.5),
    (("border", "focus"), ("panel", "raised", "bg"), 3.0),
    (("selection_text",), ("selection",), 4.5),
    (("on_dark",), ("pill_grey", "pill_blue", "pill_red", "stop", "reset"), 4.5),
    (("on_light",), ("pill_green", "pill_yellow"), 4.5),
    (("panel",), ("text",), 4.5),  # the primary button
]


@pytest.mark.promise("W9")
@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
@pytest.mark.parametrize(("inks", "grounds", "least"), PAIRS)
def test_inks_can_be_read_on_their_grounds(tokens, inks, grounds, least):
    for ink, ground in product(inks, grounds):
        assert ratio(tokens, ink, ground) >= least, (ink, ground)


def rules_of(tokens) -> dict[str, dict[str, str]]:
    """Return the colours that the style sheet gives to each selector."""
    rules: dict[str, dict[str, str]] = {}
    for selectors, body in re.findall(r"([^{}]+)\{([^{}]*)\}", make_style_sheet(tokens, 10.0)):
        told = dict(re.findall(r"(?:^|[;\s])(color|background)\s*:\s*(#[0-9A-Fa-f]{6})", body))
        for selector in selectors.split(","):
            rules.setdefault(selector.strip(), {}).update(told)
    return rules


@pytest.mark.promise("W9")
@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
def test_every_pair_of_the_style_sheet_can_be_read(tokens):
    """Ink and ground of every rule; what a rule does not say comes from the rule it refines."""
    rules, pairs = rules_of(tokens), 0
    for selector in rules:
        role = re.sub(r":[a-z-]+$", "", selector)
        found = [rules.get(name, {}) for name in (selector, role, re.sub(r"\[.*", "", role))]
        ink, ground = (
            next((rule[what] for rule in found if what in rule), None)
            for what in ("color", "background")
        )
        if ink is None or ground is None or ("::" in selector and "item" not in selector):
            continue
        pairs += 1
        least = 3.0 if ":disabled" in selector else 4.5
        assert contrast_ratio(QColor(ink), QColor(ground)) >= least, selector
    assert pairs > 25


def test_the_reading_of_rules_can_fail():
    pale = replace(LIGHT, muted=LIGHT.hairline)
    with pytest.raises(AssertionError):
        test_every_pair_of_the_style_sheet_can_be_read(pale)


def test_arrows_are_seen_on_the_dimmed_gel():
    """#464646 is the grey of a gel's picture at 70 %."""
    for colour in BIN_COLOURS:
        assert contrast_ratio(QColor(colour), QColor("#464646")) >= 3.0
        assert contrast_ratio(QColor(colour), QColor(ARROWS_ON)) >= 3.0


@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
def test_disabled_is_legible_and_fainter_than_text(tokens):
    for ground in ("panel", "bg"):
        assert 3.0 <= ratio(tokens, "disabled", ground) <= 0.5 * ratio(tokens, "text", ground)


@pytest.mark.parametrize("kind", [QPushButton, QComboBox, QSpinBox, QLineEdit])
def test_in_high_contrast_a_disabled_control_has_a_broken_frame(qapp, qtbot, kind):
    """Ink along the left edge: whole when enabled, with gaps when disabled."""
    load_resources()
    control = kind()
    qtbot.addWidget(control)
    control.setStyleSheet(make_style_sheet(CONTRAST, 10.0))
    control.resize(120, 60)

    def share():
        image = control.grab().toImage()
        edge = [image.pixelColor(0, y).lightness() > 64 for y in range(15, image.height() - 15)]
        return sum(edge) / len(edge)

    assert share() == 1.0
    control.setEnabled(False)
    assert 0.2 < share() < 0.9


def test_in_high_contrast_an_empty_progress_bar_has_a_frame(qapp, qtbot):
    load_resources()
    bar = QProgressBar()
    qtbot.addWidget(bar)
    bar.setStyleSheet(make_style_sheet(CONTRAST, 10.0))
    bar.resize(120, 24)
    image = bar.grab().toImage()
    edge = [image.pixelColor(x, y) for y in (0, image.height() - 1) for x in range(10, 110)]
    assert {colour.name() for colour in edge} == {CONTRAST.border.lower()}


@pytest.mark.parametrize("kind", [QComboBox, QLineEdit, QListWidget])
@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
def test_hints_in_empty_fields_and_lists_can_be_read(qapp, qtbot, kind, tokens):
    field = kind()
    qtbot.addWidget(field)
    field.setStyleSheet(make_style_sheet(tokens, 10.0))
    field.ensurePolished()
    hint = field.palette().color(QPalette.ColorRole.PlaceholderText)
    assert hint.alpha() == 255
    assert contrast_ratio(hint, QColor(tokens.bg)) >= 4.5


@pytest.mark.promise("W10")
@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
@pytest.mark.parametrize(
    ("names", "least"),
    [
        (INKS, 30),
        (("pill_grey", "pill_blue", "pill_green", "pill_yellow", "pill_red"), 20),
        (("good", "bad"), 20),  # they have a mark and a word besides
    ],
)
def test_colours_differ_for_every_vision(tokens, names, least):
    assert smallest_distance([getattr(tokens, name) for name in names]) >= least


def test_outlines_on_photographs_are_seen_and_differ():
    """What is seen by the camera is dotted besides; the letters lie on black."""
    colours = {kind: colour for kind, (colour, _) in OUTLINE_STYLES.items()}
    for colour in colours.values():
        assert contrast_ratio(QColor(colour), QColor("#6B6B6B")) >= 3.0
        assert contrast_ratio(QColor(colour), QColor("#000000")) >= 4.5
    assert smallest_distance([colours["bottom"], colours["label"]]) >= 20
    assert smallest_distance(list(colours.values())) >= 13


def test_every_colour_that_is_no_token_is_one_of_those_looked_at_here():
    """White and black are marks that lie on each other; the ground of the arrows is always dark."""
    known = {*BIN_COLOURS, *(colour for colour, _ in OUTLINE_STYLES.values())}
    known |= {"#FFFFFF", "#000000", ARROWS_ON, splash.GROUND, splash.TEXT}
    known |= {colour.name().upper() for *_, colour in OUTLINES.values()}  # on black
    assert all(contrast_ratio(c, QColor("#000000")) >= 4.5 for *_, c in OUTLINES.values())
    assert contrast_ratio(QColor(splash.GROUND), QColor(splash.TEXT)) >= 4.5
    theme, found = ROOT / "widgets" / "base" / "theme.py", set()
    for file in (*(ROOT / "widgets").rglob("*.py"), *(ROOT / "app").rglob("*.py")):
        if file != theme:
            found |= set(re.findall(r"#[0-9A-Fa-f]{6}\b", file.read_text("utf-8")))
    assert found
    assert found <= known


@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
def test_ticks_and_arrows_of_controls_are_seen(tokens):
    for name in ("tick", "up", "down"):
        drawing = (ROOT / "resources" / "icons" / f"{name}-{tokens.name}.svg").read_text("utf-8")
        inks = re.findall(r"#[0-9A-Fa-f]{6}", drawing)
        assert inks
        for ink in inks:
            assert contrast_ratio(QColor(ink), tokens.colour("bg")) >= 3.0


@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
@pytest.mark.parametrize("name", MAPS)
def test_every_dot_of_a_distribution_is_seen_on_its_ground(tokens, name):
    for shade in legible_colours(np.linspace(0, 1, 33), name, tokens).tolist():
        assert contrast_ratio(QColor(*shade), tokens.colour("bg")) >= 3.0


@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
def test_the_lines_of_the_sources_are_seen_and_told_apart(tokens):
    colours = [getattr(tokens, token) for _, token in GHOST_STYLES.values()]
    assert min(contrast_ratio(QColor(c), tokens.colour("bg")) for c in colours) >= 3.0
    assert smallest_distance(colours) >= 10


def test_the_distance_test_can_fail():
    assert smallest_distance(["#1B5E20", "#B3261E"]) < 10


@pytest.mark.parametrize("tokens", THEMES, ids=IDS)
@pytest.mark.parametrize("state", get_args(ChipState))
def test_the_mark_of_a_chip_is_told_from_the_chip_and_a_warning_is_yellow(tokens, state):
    ink, rim = mark_colours(state, tokens)
    for ground in ("raised", "hover"):
        assert contrast_ratio(rim or ink, tokens.colour(ground)) >= 3.0
    if state in ("degraded", "stale"):
        assert ink == tokens.colour("pill_yellow")
