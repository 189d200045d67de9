"""Nonsense in the pipe or in the shared memory: no crash, no hang, and the arm is stopped."""

import io
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.backend.rig.hosted import Hosted
from touchdown.backend.rig.memory import NOTES, POSES, ROUNDS, STATE, WRENCH, drop, make
from touchdown.backend.rig.messages import KINDS, LENGTH, MOST_BYTES, Channel, pack

LIMIT_S = 30.0
PLAIN = st.sampled_from([None, True, 0, -1, 10**30, 0.5, math.nan, math.inf, "", "x"])
JSON = PLAIN | st.lists(PLAIN, max_size=3) | st.dictionaries(st.sampled_from("ab"), PLAIN)
ORDERS = st.sampled_from(["arm.move_to", "arm.jog", "arm.servo", "gripper.grip", "wrist.fly", ""])
NAMES = st.sampled_from(
    ["id", "order", "args", "stops", "faults", "limits", "motion", "lease_until_s", "fault"]
)
MESSAGES = st.builds(
    lambda kind, order, rest: pack({"order": order, **rest, "kind": kind}),
    # A retreat needs no content to make sense.
    st.sampled_from(sorted(KINDS - {"retreat"})),
    ORDERS,
    st.dictionaries(NAMES, JSON, max_size=5),
)


def listen(content, take):
    """Let one end of a pipe hear ``content``; return how often it was told that it ended."""
    ended = []
    channel = Channel(io.BytesIO(content), io.BytesIO(), take, lambda: ended.append(True))
    channel.start()
    channel.close()
    channel.join(LIMIT_S)
    assert not any(thread.is_alive() for thread in (channel._speaker, channel._listener))
    return len(ended)


@pytest.fixture(scope="module")
def rig():
    made = Hosted().connected()
    yield made
    made.close()


@settings(max_examples=150)
@given(st.binary(max_size=200), st.booleans())
def test_bytes_that_are_no_messages_end_the_pipe(content, framed):
    heard = []
    assert listen(LENGTH.pack(len(content)) + content if framed else content, heard.append) == 1
    assert all(message["kind"] in KINDS for message in heard)


@pytest.mark.parametrize(
    "content",
    [
        LENGTH.pack(MOST_BYTES + 1) + b"x" * 100,
        LENGTH.pack(0xFFFFFFFF),
        LENGTH.pack(60_000) + b"[" * 60_000,
        LENGTH.pack(60_000) + b"{}",
        LENGTH.pack(4) + b"\xff\xfe\x00\x01",
    ],
    ids=["too long", "endless", "deep", "cut", "no text"],
)
def test_hostile_lengths_and_depths_end_the_pipe_too(content):
    assert listen(content, lambda message: None) == 1


@pytest.mark.promise("P8", "P9")
@settings(max_examples=60)
@given(st.lists(MESSAGES, min_size=1, max_size=4))
def test_messages_of_a_known_kind_with_senseless_content_move_nothing(rig, messages):
    """Whoever speaks so is gone for the rig, or is answered with an error: nothing moves."""
    sent = len(rig.arms.wires.packets)
    before = rig.arm.describe()["z_mm"]
    assert listen(b"".join(messages), rig.host.take) == 1
    rig.rounds(0.008)
    assert len(rig.arms.wires.packets) > sent
    assert rig.arm.describe()["z_mm"] == before
    assert rig.log.count("stop gripper") == len(rig.log)


@pytest.mark.promise("P8", "P9")
def test_a_pipe_full_of_nonsense_stops_an_arm_that_moves(rig):
    rig.host.take({"kind": "reset", "stops": 10**6, "faults": 10**6})
    stops = rig.arms.wires.stops
    nonsense = LENGTH.pack(2) + json.dumps([]).encode()
    channel = Channel(io.BytesIO(nonsense), io.BytesIO(), rig.host.take, rig.host.abandon)
    channel.start()
    channel.close()
    channel.join(LIMIT_S)
    assert rig.arms.wires.stops == stops + 1
    assert rig.rounds(0.004)


@pytest.mark.promise("P8", "P9")
@settings(max_examples=30)
@given(
    st.sampled_from([STATE, WRENCH, POSES, ROUNDS, NOTES]),
    st.integers(-(2**62), 2**62),
    st.integers(0, 2**32 - 1),
)
def test_shared_memory_full_of_noise_is_read_without_a_crash(word, count, seed):
    memory, path = make()
    drop(path)
    words = memory._words.copy()
    noise = np.random.default_rng(seed).integers(0, 256, len(memory._pages), dtype=np.uint8)
    np.frombuffer(memory._pages, np.uint8)[:] = noise
    memory._words[:] = words
    memory._words[word] = count
    assert memory.seen() is None
    assert memory.notes() == []
    for ring in (memory.wrench, memory.poses, memory.rounds):
        t_s, values, cursor = ring.since(0)
        assert (len(t_s), len(values), cursor) == (0, 0, ring.count)
