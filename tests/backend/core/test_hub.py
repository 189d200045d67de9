"""Events: none is lost and order is kept; a slow reader loses the oldest and counts them."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.core.event_bus import EventBus, EventQueue
from touchdown.backend.core.events import Said


def _fact(number: int) -> Said:
    return Said(float(number), str(number))


def test_every_subscriber_gets_every_fact_in_order():
    hub, first, second = EventBus(), [], []
    hub.subscribe(first.append)
    hub.subscribe(second.append)
    facts = [_fact(i) for i in range(100)]
    for fact in facts:
        hub.publish(fact)
    assert first == facts
    assert second == facts


def test_who_left_hears_nothing_and_may_leave_twice():
    hub, heard = EventBus(), []
    leave = hub.subscribe(heard.append)
    hub.publish(_fact(0))
    leave()
    leave()
    hub.publish(_fact(1))
    assert heard == [_fact(0)]


def test_a_subscriber_may_leave_while_it_is_told():
    hub, heard = EventBus(), []

    def once(fact):
        heard.append(fact)
        leave()

    leave = hub.subscribe(once)
    late = []
    hub.subscribe(late.append)
    hub.publish(_fact(0))
    hub.publish(_fact(1))
    assert heard == [_fact(0)]
    assert late == [_fact(0), _fact(1)]


def test_a_fact_published_by_a_subscriber_reaches_all():
    hub, heard = EventBus(), []

    def answer(fact):
        if fact.t_s == 0:
            hub.publish(_fact(1))

    hub.subscribe(answer)
    hub.subscribe(heard.append)
    hub.publish(_fact(0))
    assert sorted(fact.t_s for fact in heard) == [0.0, 1.0]


def test_two_publishers_never_interleave_within_one_fact():
    hub, log = EventBus(), []
    hub.subscribe(lambda fact: log.append(("a", fact.text)))
    hub.subscribe(lambda fact: log.append(("b", fact.text)))

    def publish(start):
        for i in range(start, start + 300):
            hub.publish(_fact(i))

    threads = [threading.Thread(target=publish, args=(start,)) for start in (0, 1000, 2000)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(log) == 2 * 900
    assert all(log[i][1] == log[i + 1][1] and log[i][0] == "a" for i in range(0, len(log), 2))


@given(st.integers(1, 20), st.lists(st.booleans(), max_size=200))
def test_a_mailbox_keeps_the_newest_and_counts_the_rest(capacity, moves):
    """Against a plain list: True puts the next fact, False takes one."""
    box, model, put, dropped = EventQueue(capacity), [], 0, 0
    for is_put in moves:
        if is_put:
            box(_fact(put))
            model.append(_fact(put))
            put += 1
            if len(model) > capacity:
                model.pop(0)
                dropped += 1
        else:
            assert box.take() == (model.pop(0) if model else None)
    assert box.dropped == dropped
    rest = []
    while (fact := box.take()) is not None:
        rest.append(fact)
    assert rest == model


def test_facts_cannot_be_changed():
    with pytest.raises(AttributeError):
        _fact(0).text = "other"
