"""Motion JPEG: pictures out of any chunks, back in step after damage; sizes as OpenCV made them."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.devices.cameras.frames import JpegStream, size_px
from touchdown.backend.devices.framing import ProtocolError


def jpeg(seed, width=64, height=48):
    noise = np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", noise)[1].tobytes()


PICTURES = [jpeg(seed) for seed in range(3)]


@given(st.lists(st.integers(1, 900), min_size=1, max_size=30))
def test_any_cutting_gives_the_same_pictures(lengths):
    content, stream, found = b"".join(PICTURES), JpegStream(), []
    for length in (*lengths, len(content)):
        piece, content = content[:length], content[length:]
        found += stream.feed(piece)
    assert found == PICTURES
    assert (stream.bad_frames, stream.discarded, stream.pending) == (0, 0, 0)


def test_a_cut_picture_is_refused_and_the_next_is_whole():
    stream = JpegStream()
    found = stream.feed(PICTURES[0][:-100] + PICTURES[1] + b"noise" + PICTURES[2])
    assert found == PICTURES[1:]
    assert stream.bad_frames == 1
    assert stream.discarded == len(PICTURES[0]) - 100 + 5


@given(st.binary(max_size=400))
def test_noise_is_left_out(noise):
    found = JpegStream().feed(noise + PICTURES[0] + PICTURES[1])
    assert found[-1] == PICTURES[1]


@pytest.mark.parametrize(("width", "height"), [(64, 48), (320, 240), (1640, 1232)])
def test_the_size_is_that_of_the_picture(width, height):
    assert size_px(jpeg(0, width, height)) == (width, height)


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xd8", PICTURES[0][:15], b"\xff\xd8\xff\xe0\x00\x00"]
)
def test_no_size_without_a_header(content):
    with pytest.raises(ProtocolError):
        size_px(content)
