"""A short fuzz of every decoder; and the fuzz finds what is planted."""

import pytest

from backend.wire import optoforce
from tests.fuzz.wire import ALL, fuzz

SHORT = 150


@pytest.mark.parametrize("key", sorted(ALL), ids="/".join)
def test_damaged_bytes_do_no_harm(key):
    count = fuzz(key, 7, lambda count: count.inputs == SHORT)
    assert count.findings == []
    assert count.octets > 0


def test_a_check_that_is_missing_is_found(monkeypatch):
    monkeypatch.setattr(optoforce, "_summed", lambda frame: frame[:-2])
    count = fuzz(("optoforce", "device-to-pc"), 7, lambda count: count.inputs == SHORT)
    assert any("was never sent" in finding for finding in count.findings)


def test_a_crash_is_found(monkeypatch):
    monkeypatch.setattr(optoforce, "_length", lambda data, at: data[at + 1])
    count = fuzz(("optoforce", "device-to-pc"), 7, lambda count: count.inputs == SHORT)
    assert any("raised IndexError" in finding for finding in count.findings)


def test_the_same_seed_gives_the_same_counts():
    key = ("wsg-binary", "device-to-pc")
    first, second = (fuzz(key, 3, lambda count: count.inputs == SHORT) for _ in range(2))
    assert (first.octets, first.messages) == (second.octets, second.messages)
    assert first.messages > 0
