"""A disk that takes its time: on a bench in real time the sensors are read meanwhile."""

import threading
from types import SimpleNamespace

import pytest

from backend.runs import store as store_module
from backend.runs.plan import Waiting
from backend.runs.room import durable
from backend.runs.store import RunStore


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """A store with an episode on its way to a disk that is done once ``done`` is set."""
    done = threading.Event()
    monkeypatch.setattr(store_module, "write_episode", lambda *_, **__: done.wait(30.0))
    store = RunStore(tmp_path, {})
    store.keep(SimpleNamespace(episode_id="one"))
    yield store, done
    done.set()
    store.close()


def test_a_plan_goes_on_waiting_by_steps_until_the_episode_is_written(slow):
    store, done = slow
    plan = durable(SimpleNamespace(store=store, real_time=True))
    waiting = next(plan)
    assert isinstance(waiting, Waiting)
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
        next(durable(SimpleNamespace(store=store, real_time=False)))
    assert ended.value.value.name == "one.mcap"
