"""A repaint hold ends when it is ended, or by itself."""

from touchdown.backend.core.scheduling import RepaintHold


def test_it_ends_by_itself_if_nobody_ends_it():
    now = [10.0]
    hush = RepaintHold(lambda: now[0])
    assert not hush.on
    hush.begin(0.08)
    assert hush.on
    now[0] = 10.079
    assert hush.on
    now[0] = 10.081
    assert not hush.on


def test_it_ends_with_the_decision():
    hush = RepaintHold(lambda: 0.0)
    hush.begin(0.08)
    hush.end()
    assert not hush.on
