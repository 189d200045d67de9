"""Display of calibrated values."""

import pytest

from touchdown.backend.calibration.result import format_value


@pytest.mark.parametrize(
    ("name", "value", "sigma", "unit", "words"),
    [
        ("exchanged", 0.0, 0.0, "", "no"),
        ("exchanged", 1.0, 0.0, "", "yes"),
        ("left_mirror", 0.0, 0.0, "", "no"),
        ("right_mirror", 3.0, 0.0, "", "in x and y"),
        ("left_mirror", 2.0, 0.0, "", "in y"),
        ("x_mm", -0.1234, 0.05, "mm", "\N{MINUS SIGN}0.123 \N{PLUS-MINUS SIGN} 0.050 mm"),
        ("yaw_rad", 0.01, 0.001, "rad", "0.573° \N{PLUS-MINUS SIGN} 0.057°"),
    ],
)
def test_values_have_words_digits_and_units(name, value, sigma, unit, words):
    assert format_value(name, value, sigma, unit) == words
