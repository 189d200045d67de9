"""Orders wait only for those of their own device, and the rig ends without two threads at one."""

import threading

import pytest

from tests.backend.rig.hosted import Hosted
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.rig import process
from touchdown.backend.rig.host import DeviceWorkers


@pytest.fixture
def rig():
    made = Hosted()
    yield made
    made.close()


def test_an_order_waits_for_none_of_another_device_and_after_leaving_none_begins():
    hold, begun, done = threading.Event(), threading.Event(), []

    def carry_out(order):
        if order["id"] == 1:
            begun.set()
            assert hold.wait(30.0)
        done.append(order["id"])

    workers = DeviceWorkers(("arm", "gripper"), carry_out)
    assert workers.give("arm", {"id": 1})
    assert workers.give("arm", {"id": 2})
    assert workers.give("gripper", {"id": 3})
    assert not workers.give("head", {"id": 4})
    assert begun.wait(30.0)
    workers.leave()
    assert not workers.idle("arm", 0.0)
    hold.set()
    assert workers.idle("arm", 30.0)
    assert workers.idle("gripper", 30.0)
    assert 1 in done
    assert 2 not in done


def test_the_rig_closes_no_device_that_is_just_being_connected(rig, monkeypatch):
    begun, free = threading.Event(), threading.Event()

    def connect(timeout_s, cancel):
        rig.wrist.state = DeviceState.CONNECTING
        begun.set()
        assert free.wait(30.0)

    monkeypatch.setattr(process, "FAREWELL_S", 0.05)
    monkeypatch.setattr(rig.wrist, "connect", connect)
    order = {"kind": "order", "id": 1, "order": "force_torque.connect", "args": {"timeout_s": 1.0}}
    rig.host.take({**order, "lease_until_s": rig.lease_s()})
    assert begun.wait(30.0)
    process._end(rig.host)
    assert rig.gripper.state is DeviceState.CLOSED
    assert rig.wrist.state is DeviceState.CONNECTING
    free.set()
    assert rig.host.workers.idle("force_torque", 30.0)
    process._end(rig.host)
    assert rig.wrist.state is DeviceState.CLOSED
