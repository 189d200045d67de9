"""What holds for every decoder: round trip, any cut, noise before, loss within, one flipped bit."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.backend.devices.codecs.codecs import CODECS
from tests.backend.devices.codecs.messages import MESSAGES

ALL = sorted(CODECS)
STREAMS = [key for key in ALL if CODECS[key].stream]
TEXTS = {("dynpick", "pc-to-device"), ("bota", "pc-to-device")}
"""Commands of single letters, which noise can spell."""
SUMMED = {"wsg-binary", "robotiq-ft300", "bota", "optoforce"}
CHECKED = [key for key in STREAMS if key[0] in SUMMED and key not in TEXTS]
"""Streams with a checksum of 16 bits: what comes out was sent."""
FRAMED = [key for key in STREAMS if key not in TEXTS]

few = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
by_key = pytest.mark.parametrize("key", ALL, ids="/".join)
by_stream = pytest.mark.parametrize("key", STREAMS, ids="/".join)


def encoded(codec, messages):
    return [codec.encode(message) + extra(codec, message) for message in messages]


def extra(codec, message):
    content = codec.encode(message)
    return codec.end if codec.end and not content.endswith(b"\n") else b""


def is_subsequence(part, whole):
    rest = iter(whole)
    return all(any(item == other for other in rest) for item in part)


@by_key
@few
@given(data=st.data())
def test_every_message_comes_back(key, data):
    codec = CODECS[key]
    message = data.draw(MESSAGES[key])
    (frame,) = encoded(codec, [message])
    assert codec.messages(frame) == [message]


@pytest.mark.promise("S1")
@by_stream
@few
@given(data=st.data())
def test_where_the_stream_is_cut_does_not_matter(key, data):
    codec = CODECS[key]
    messages = data.draw(st.lists(MESSAGES[key], max_size=5))
    content = b"".join(encoded(codec, messages))
    decoder, out = codec.stream(), []
    while content:
        cut = data.draw(st.integers(1, len(content)))
        out += decoder.feed(content[:cut])
        content = content[cut:]
    assert out == messages
    assert decoder.bad_frames == decoder.discarded == decoder.pending == 0


@pytest.mark.promise("S1")
@pytest.mark.parametrize("key", FRAMED, ids="/".join)
@few
@given(data=st.data())
def test_after_noise_the_third_frame_at_the_latest_is_read(key, data):
    codec = CODECS[key]
    noise = data.draw(st.binary(max_size=60))
    messages = data.draw(st.lists(MESSAGES[key], min_size=3, max_size=6))
    decoder = codec.stream()
    frames = [noise, *encoded(codec, messages)]
    segments = [b"".join(frames)] if data.draw(st.booleans()) else frames
    out = [m for segment in segments for m in decoder.feed(segment)]
    assert out[len(out) - len(messages) + 2 :] == messages[2:]


@pytest.mark.parametrize("key", FRAMED, ids="/".join)
@few
@given(data=st.data())
def test_after_a_frame_cut_short_the_third_is_read(key, data):
    codec = CODECS[key]
    first, *messages = data.draw(st.lists(MESSAGES[key], min_size=4, max_size=6))
    frame, *frames = encoded(codec, [first, *messages])
    decoder = codec.stream()
    decoder.feed(frame[: data.draw(st.integers(1, len(frame)))])
    out = [m for following in frames for m in decoder.feed(following)]
    assert out[len(out) - len(messages) + 2 :] == messages[2:]


@pytest.mark.promise("S3")
@pytest.mark.parametrize("key", CHECKED, ids="/".join)
@few
@given(data=st.data())
def test_one_flipped_bit_never_makes_a_message(key, data):
    codec = CODECS[key]
    messages = data.draw(st.lists(MESSAGES[key], min_size=1, max_size=4))
    content = bytearray(b"".join(encoded(codec, messages)))
    place = data.draw(st.integers(0, 8 * len(content) - 1))
    content[place // 8] ^= 1 << place % 8
    out = [
        m
        for m in codec.messages(bytes(content))
        if type(m).__name__ not in ("WsgRefusal", "ModbusRefusal", "StreamStop")
    ]
    assert is_subsequence(out, messages)


@pytest.mark.parametrize("key", [key for key in ALL if key not in STREAMS], ids="/".join)
@few
@given(data=st.data())
def test_a_datagram_of_another_length_is_refused(key, data):
    codec = CODECS[key]
    frame = codec.encode(data.draw(MESSAGES[key]))
    short = data.draw(st.integers(0, len(frame) - 1).filter(lambda n: n == 0 or n % 36))
    assert codec.messages(frame[:short]) == []
    assert codec.messages(frame + b"\x00") == []


@by_key
@few
@given(content=st.binary(max_size=400))
def test_noise_never_raises(key, content):
    CODECS[key].messages(content)
    CODECS[key].messages(content, cut=3)


@pytest.mark.promise("S1")
@by_stream
@few
@given(content=st.binary(max_size=3000))
def test_what_is_kept_of_noise_stays_small(key, content):
    decoder = CODECS[key].stream()
    for at in range(0, len(content), 50):
        decoder.feed(content[at : at + 50])
    assert decoder.pending <= (4096 if key[0] == "melfa-r3" else 330)
    decoder.reset()
    assert decoder.pending == 0
