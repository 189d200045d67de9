"""Slow disk: on a bench in real time the sensors are read during a write."""

import threading
from types import SimpleNamespace

import pytest

from touchdown.backend.runs import recorder as store_module
from touchdown.backend.runs.plan import Wait
from touchdown.backend.runs.recorder import RunStore, wait_until_durable


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """Episode store with a write that ends once ``done`` is set."""
    done = threading.Event()
    monkeypatch.setattr(store_module, "write_episode", lambda *_, **__: done.wait(30.0))
    store = RunStore(tmp_path, {})
    store.keep(SimpleNamespace(episode_id="one"))
    yield store, done
    done.set()
    store.close()


def test_a_plan_goes_on_waiting_by_steps_until_the_episode_is_written(slow):
    store, done = slow
    plan = wait_until_durable(SimpleNamespace(store=store, real_time=True))
    waiting = next(plan)
    assert isinstance(waiting, Wait)
    assert not waiting.until()
    done.set()
    store._pending.result(30.0)
    assert waiting.until()
    with pytest.raises(StopIteration) as ended:
        next(plan)
    assert ended.value.value.name == "one.mcap"


def test_a_stepped_bench_lets_no_time_of_its_own_pass(slow):
    store, done = slow
    threading.Timer(0.05, done.set).start()
    with pytest.raises(StopIteration) as ended:
        next(wait_until_durable(SimpleNamespace(store=store, real_time=False)))
    assert ended.value.value.name == "one.mcap"
