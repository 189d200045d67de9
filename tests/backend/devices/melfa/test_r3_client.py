"""The command channel: one request at a time, replies in any pieces, late ones, silence, STOP."""

import pytest

from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.melfa.command_channel import R3Client
from touchdown.backend.devices.melfa.faults import controller_fault, link_fault
from touchdown.backend.devices.melfa.r3_protocol import R3Request

STATE, STOP, OVERRIDE = R3Request("STATE"), R3Request("STOP"), R3Request("OVRD")


@pytest.fixture
def client():
    return R3Client(0.03)


def test_one_request_is_on_the_wire_at_a_time(client):
    first, second = client.ask(STATE), client.ask(OVERRIDE)
    assert client.step(0.0, b"") == b"1;1;STATE\r"
    assert client.step(0.01, b"") == b""
    assert client.step(0.02, b"QoKa\r") == b"1;1;OVRD\r"
    assert (first.answer, second.done) == ("a", False)
    client.step(0.03, b"QoK50\r\n")
    assert second.answer == "50"


@pytest.mark.promise("R10")
def test_replies_may_be_split_merged_or_without_an_end(client):
    tickets = [client.ask(OVERRIDE) for _ in range(3)]
    client.step(0.0, b"")
    client.step(0.001, b"Qo")
    client.step(0.002, b"K10\rQo")
    client.step(0.003, b"K20\r")
    assert [t.done for t in tickets] == [True, True, False]
    client.step(0.004, b"QoK30")
    assert not tickets[2].done
    client.step(0.040, b"")
    assert [t.answer for t in tickets] == ["10", "20", "30"]


def test_stop_goes_before_what_is_not_yet_sent_and_keeps_no_distance(client):
    client.paced = True
    client.ask(STATE)
    client.step(0.0, b"")
    client.ask(OVERRIDE)
    client.ask(STOP)
    assert client.step(0.01, b"QoKa\r") == b"1;1;STOP\r"
    assert client.step(0.02, b"QoK\r") == b""
    assert client.step(0.11, b"") == b""
    assert client.step(0.121, b"") == b"1;1;OVRD\r"


@pytest.mark.promise("R10")
def test_a_late_reply_is_not_taken_for_the_answer_of_the_next(client):
    first = client.ask(STATE)
    client.step(0.0, b"")
    second = client.ask(OVERRIDE)
    assert client.step(1.0, b"") == b""
    with pytest.raises(FaultError, match="STATE"):
        _ = first.answer
    assert client.step(1.5, b"QoKlate\r") == b"1;1;OVRD\r"
    client.step(1.6, b"QoK50\r")
    assert second.answer == "50"


@pytest.mark.promise("R10")
def test_three_seconds_of_silence_are_a_lost_link_for_all_that_wait(client):
    tickets = [client.ask(STATE), client.ask(OVERRIDE)]
    client.step(0.0, b"")
    client.step(1.5, b"")
    with pytest.raises(FaultError) as raised:
        client.step(3.0, b"")
    assert raised.value.fault.code == "ARM-LINK"
    assert all(ticket.done for ticket in tickets)
    after = client.ask(STATE)
    assert after.done
    with pytest.raises(FaultError):
        _ = after.answer


def test_silence_counts_only_while_something_is_owed(client):
    ticket = client.ask(STATE)
    client.step(0.0, b"")
    client.step(0.1, b"QoKa\r")
    client.step(60.0, b"")
    assert ticket.answer == "a"


def test_garbage_is_counted_and_answers_nothing(client):
    ticket = client.ask(STATE)
    client.step(0.0, b"")
    client.step(0.1, b"\x00\xff?\rnonsense\r")
    assert client.bad_replies == 2
    assert not ticket.done
    client.step(0.2, b"QoKa\r")
    assert ticket.answer == "a"


def test_a_refusal_is_a_fault_with_its_number(client):
    ticket = client.ask(STATE)
    client.step(0.0, b"")
    client.step(0.1, b"QeR6020\r")
    with pytest.raises(FaultError) as raised:
        _ = ticket.answer
    assert raised.value.fault == controller_fault(6020)


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (50, "HW-STOP"),
        (71, "HW-STOP"),
        (2602, "OUT-OF-RANGE"),
        (2000, "NOT-READY"),
        (4140, "REJECTED"),
        (1, "CONTROLLER"),
        (12345, "CONTROLLER"),
    ],
)
def test_each_number_is_of_one_class(number, code):
    fault = controller_fault(number, "text")
    assert fault.code == code
    assert str(number) in fault.what
    assert fault.next_step != link_fault("").next_step
