"""The time spent on an episode, as the figures of agreement quote it."""

import pytest

from touchdown.app.label.editing import ViewingTimer


@pytest.fixture
def clock():
    time_s = [100.0]
    made = ViewingTimer(lambda: time_s[0])
    made.pass_s = lambda s: time_s.__setitem__(0, time_s[0] + s)
    return made


def test_a_pause_of_more_than_a_minute_is_not_looking(clock):
    for seconds in (5.0, 60.0, 61.0, 3600.0, 2.0):
        clock.pass_s(seconds)
        clock.alive()
    assert clock.seen_ms() == 67_000


def test_the_next_episode_begins_anew(clock):
    clock.pass_s(7.0)
    clock.alive()
    clock.restart()
    clock.pass_s(3.0)
    assert clock.seen_ms() == 3_000
