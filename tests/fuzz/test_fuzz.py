"""A short fuzz of every decoder; and the fuzz finds what is planted."""

import pytest

from tests.fuzz.wire import ALL, Count, attempt, fuzz
from touchdown.backend.devices.optoforce import protocol

SHORT = 150


@pytest.mark.parametrize("key", sorted(ALL), ids="/".join)
def test_damaged_bytes_do_no_harm(key):
    count = fuzz(key, 7, lambda count: count.inputs == SHORT)
    assert count.findings == []
    assert count.octets > 0


FOUND = {
    ("wsg-binary", "pc-to-device"): [
        "aaaaaaaa230000ac1caaaa230000ac1caaaaaa40030001003e436caaaaaa070000354c",
        "aaaaaa210900010000a0c40000a041f6500080db87aaaa500000dbaaaa128981e5170a23ae1f8939aa230000ac1c87",
    ],
    ("wsg-binary", "device-to-pc"): [
        "aaaaaa2502001200e4c9aaaaaa210200120067ebaaaaaa25000a2287aaaa8a400600000001100000e5d1",
        "aaaaaaaaaa4103000000970910720fbc7200bd72aa43060000000800a441945a",
        "aaaaae21020010004822aaaaaa2502001c008d3272",
    ],
}
"""Inputs that once made a message nobody had sent."""


@pytest.mark.parametrize(("key", "content"), [(k, c) for k, some in FOUND.items() for c in some])
@pytest.mark.parametrize("cut", [None, 1, 7, 64])
def test_what_was_found_once_stays_mended(key, content, cut):
    count = Count()
    attempt(key, bytes.fromhex(content), cut, count)
    assert count.findings == []


@pytest.mark.parametrize(
    ("name", "planted", "found"),
    [
        ("_summed", lambda frame: frame[:-2], "was never sent"),
        ("_length", lambda data, at: data[at + 1], "raised IndexError"),
    ],
)
def test_a_missing_check_and_a_crash_are_found(monkeypatch, name, planted, found):
    monkeypatch.setattr(protocol, name, planted)
    count = fuzz(("optoforce", "device-to-pc"), 7, lambda count: count.inputs == SHORT)
    assert any(found in finding for finding in count.findings)


def test_the_same_seed_gives_the_same_counts():
    key = ("wsg-binary", "device-to-pc")
    first, second = (fuzz(key, 3, lambda count: count.inputs == SHORT) for _ in range(2))
    assert (first.octets, first.messages) == (second.octets, second.messages)
    assert first.messages > 0
