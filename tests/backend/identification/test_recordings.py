"""Recordings for an identification: what is refused, and how presses are sampled."""

import numpy as np
import pytest

from tests.backend.identification.made import made_press
from touchdown.backend.annotations import Dataset
from touchdown.backend.core import InputError
from touchdown.backend.geometry import load_pieces
from touchdown.backend.identification import read_recordings
from touchdown.backend.identification.recordings import Delays, refuse_unusable, sample_presses

LIBRARY = load_pieces()


@pytest.fixture(scope="module")
def presses():
    return [made_press(k) for k in range(24)]


def test_good_presses_are_not_refused(presses):
    refuse_unusable(presses, LIBRARY, "here")


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"grip": "one"}, "1 grippings"),
        ({"mounting": "one"}, "1 mountings"),
        ({"bottom": "short"}, "The bottom short can move"),
        ({"offset_mm": np.zeros(2)}, "within 4 mm"),
        ({"wrench_t_s": np.arange(2400) * 0.02}, "50 Hz"),
        ({"pose_mm": np.zeros((240, 3))}, "the arm does not move"),
        ({"wrench": np.full((2400, 6), 9.0)}, "saturated at 9.0 N"),
        ({"fields": ()}, "the left camera gives fewer"),
    ],
)
def test_unusable_recordings_are_refused_with_what_is_missing(changes, what):
    bad = [made_press(k, **changes) for k in range(24)]
    with pytest.raises(InputError) as refused:
        refuse_unusable(bad, LIBRARY, "here")
    assert what in refused.value.what
    assert "ecord" in refused.value.fix


def test_too_few_presses_are_refused(presses):
    with pytest.raises(InputError, match="3 presses"):
        refuse_unusable(presses[:3], LIBRARY, "here")


def test_an_empty_dataset_has_no_recordings(tmp_path):
    with Dataset.open(tmp_path / "ds", person="ann") as dataset:
        found = read_recordings(dataset)
    assert (found.presses, found.rest) == ((), None)


def test_signals_count_from_the_air_before_contact():
    late = made_press(0, wrench_late_s=0.02, markers_late_s=0.03)
    found = sample_presses([late], Delays(0.02, 0.05))
    depth = 1.0  # of the hand at the end: 0.2 mm of descent, 0.8 mm of ramp
    assert found.motion_mm[0, -1, 2] == pytest.approx(-depth, abs=1e-9)
    assert found.wrench[0, -1, 2] == pytest.approx(5.0 * depth, abs=0.02)
    assert found.field_px[0, -1, 0, :, 1].mean() == pytest.approx(-17.0 * depth, abs=0.05)
    assert found.contact_mm[0] == pytest.approx(30.0)
