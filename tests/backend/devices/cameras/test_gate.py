"""Frozen pictures are found at once, and noise alone keeps a picture of a still gel alive."""

import cv2
import numpy as np
import pytest

from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.devices.cameras.frames import (
    DARK_FAULT,
    EQUAL_FAULT,
    EQUAL_INVALID,
    PictureFilter,
)

SETTINGS = GelsightSettings(crop_fraction=0.0)
STILL = np.full((240, 320, 3), 90, dtype=np.uint8)
NOISE_GREY = 0.5


def gate():
    return PictureFilter("left", "tactile_left", SETTINGS, 0.0)


@pytest.mark.promise("C3")
def test_the_third_equal_picture_is_none_and_the_tenth_a_fault():
    judge = gate()
    told = []
    for k in range(12):
        image = judge.judge(0.04 * k, STILL)
        told.append((image is not None, judge.fault and judge.fault.code))
    assert [good for good, _ in told] == [k + 1 < EQUAL_INVALID for k in range(12)]
    assert [k + 1 for k, (_, code) in enumerate(told) if code] == [EQUAL_FAULT]
    assert told[EQUAL_FAULT - 1][1] == "CAMERA-FROZEN"


@pytest.mark.promise("C3")
def test_a_still_gel_with_half_a_grey_level_of_noise_is_never_taken_for_frozen():
    rng, judge = np.random.default_rng(2), gate()
    small = STILL[:30, :40]
    for k in range(1000):
        noise = rng.standard_normal(small.shape, dtype=np.float32)
        picture = (small + NOISE_GREY * noise).round().astype(np.uint8)
        assert judge.judge(0.04 * k, picture) is not None
    assert judge.invalid == 0


@pytest.mark.promise("C7")
def test_lamps_that_fade_are_a_fault_of_their_own_and_one_dark_picture_is_none():
    judge, told = gate(), []
    for k, level in enumerate([90, 8, 90, *[9 + k % 2 for k in range(8)], 90]):
        image = judge.judge(0.04 * k, np.full_like(STILL, level))
        told.append((image is not None, judge.fault and judge.fault.code))
    assert [good for good, _ in told] == [True, False, True, *[False] * 8, True]
    dark = [k for k, (_, code) in enumerate(told) if code == "CAMERA-DARK"]
    assert dark == list(range(2 + DARK_FAULT, 11))
    assert judge.invalid == 9


@pytest.mark.parametrize("content", [b"", b"\xff\xd8\xff\xd9", STILL.tobytes()[:1000]])
def test_what_is_no_picture_is_counted_and_no_fault(content):
    judge = gate()
    assert judge.judge(0.0, content) is None
    assert (judge.invalid, judge.fault) == (1, None)


@pytest.mark.promise("C1")
def test_an_empty_buffer_that_is_called_a_picture_is_none():
    judge = gate()
    assert judge.judge(0.0, STILL) is not None
    assert [judge.judge(0.04 * k, b"") for k in range(1, 4)] == [None] * 3


def picture(seed, quality=90):
    rng = np.random.default_rng(seed)
    noise = np.kron(rng.integers(40, 200, (30, 40, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    return cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


@pytest.mark.promise("C4")
def test_data_that_end_early_are_no_picture():
    judge, whole = gate(), picture(1)
    assert judge.judge(0.0, whole) is not None
    short = whole[:-900] + whole[-2:]
    assert cv2.imdecode(np.frombuffer(short, np.uint8), cv2.IMREAD_COLOR) is not None
    assert judge.judge(0.04, short) is None
    assert (judge.invalid, judge.fault) == (1, None)


@pytest.mark.promise("C4")
def test_a_header_that_changed_is_believed_when_it_comes_again():
    judge = gate()
    qualities = [90, 90, 80, 80, 90, 70, 90, 70]
    taken = [judge.judge(0.04 * k, picture(k, q)) is not None for k, q in enumerate(qualities)]
    assert taken == [True, True, False, True, True, False, True, True]


def test_a_comment_that_changes_with_every_picture_is_no_new_header():
    judge = gate()
    for k in range(4):
        content = picture(k)
        comment = b"\xff\xfe\x00\x06" + b"%04d" % k
        assert judge.judge(0.04 * k, content[:2] + comment + content[2:]) is not None
