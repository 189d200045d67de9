"""Presses by the controller's own force program: the contract of an arm, and what it refuses."""

import threading
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from tests.backend.devices import contract_bench, test_arm_contract
from tests.backend.devices.contract_bench import PRESS as CONTRACT_BENCH_PRESS
from tests.backend.devices.melfa.emulated_arm import Rig, on_bench
from touchdown.backend.core import FaultError, Pose, RefusedError
from touchdown.backend.devices.melfa.command_channel import R3Client
from touchdown.backend.devices.melfa.emulated_controller import WRITTEN
from touchdown.backend.devices.melfa.faults import controller_fault, link_fault
from touchdown.backend.devices.melfa.r3_protocol import R3Request
from touchdown.backend.devices.protocols import DeviceState, PressCommand
from touchdown.backend.devices.streamed.arm import ContactStiffnessEstimate
from touchdown.backend.devices.streamed.compliance import OscillationDetector, damping
from touchdown.backend.simulation.devices.bench import SimulatedBench

CASES = [
    pytest.param(clause, more, id=name.removeprefix("test_"))
    for name, clause, more in (
        (name, clause, {"after_s": 2.5} if "every_phase" in name else {})
        for name, clause in vars(test_arm_contract).items()
        if name.startswith("test_")
        and "press" in name
        and clause.__code__.co_argcount > 0
        and "drags" not in name  # refused, see below
    )
]  # moves are those of the stream, tested elsewhere


@pytest.fixture
def made():
    bench = SimulatedBench(contract_bench._scene(contract_bench.FEW_HZ))
    return bench, *on_bench(bench, stiffness_mode="controller")


@pytest.fixture
def bench(made):
    simulated, arm, wires = made
    return contract_bench.devices_of(simulated, arm, wires.advance, still_s=0.2, still_mm=0.02)


@pytest.fixture
def controller(made):
    return made[2].device.controller


@pytest.mark.parametrize(("clause", "more"), CASES)
def test_it_keeps_the_contract_of_an_arm(bench, clause, more):
    clause(bench, **more)


def test_the_clauses_of_a_press_are_asked():
    assert len(CASES) >= 3


def test_without_a_verdict_the_program_lifts_and_the_next_move_opens_the_stream(bench, controller):
    bench.lifted_and_gripped()
    bench.finish(bench.arm.press(CONTRACT_BENCH_PRESS))
    assert controller.program == "probe"
    assert 4.0 < bench.arm.press_n < 11.0
    pressed = bench.arm.pose(0.3)
    bench.rest(3.5)
    assert controller.program == ""
    lifted = bench.arm.pose(0.3)
    assert lifted.z_mm > pressed.z_mm + 1.0
    with pytest.raises(FaultError, match="no press to unload"):
        bench.arm.unload(1.0, 2.0)
    bench.finish(bench.arm.move_to(Pose(lifted.x_mm, lifted.y_mm, lifted.z_mm + 2.0), 20.0))
    assert controller.program == "stream"
    assert bench.arm.pose(0.1).z_mm == pytest.approx(lifted.z_mm + 2.0, abs=0.1)
    assert bench.arm.state is DeviceState.READY


def test_the_place_is_fresh_enough_as_long_as_the_program_holds_the_arm(bench, controller):
    bench.lifted_and_gripped()
    bench.finish(bench.arm.press(CONTRACT_BENCH_PRESS))
    unload, oldest_s = None, 0.0
    for step in range(100):
        bench.rest(0.02)
        oldest_s = max(oldest_s, bench.now_s() - bench.arm.poses.since(0).t_s[-1])
        assert bench.arm.pose(0.2).z_mm > 0.0
        if step == 50:
            unload = bench.arm.unload(1.0, 2.0)
    assert controller.program == "probe"
    bench.finish(unload)
    # The claim is not empty: it is told more rarely than a stream tells it.
    assert oldest_s > 0.2


def test_more_than_a_probe_may_reach_is_refused_before_anything_moves(bench, controller):
    bench.lifted_and_gripped()
    with pytest.raises(RefusedError, match="PROBE-FORCE"):
        bench.arm.press(replace(CONTRACT_BENCH_PRESS, depth_mm=2.5))
    with pytest.raises(RefusedError, match="PRESS-DRAGS"):
        bench.arm.press(replace(CONTRACT_BENCH_PRESS, drag_mm=0.1))
    assert controller.program == "stream"


def test_a_program_that_is_not_in_the_controller_is_said(bench, controller):
    bench.lifted_and_gripped()
    controller.missing_programs.add("TDPROBE")
    with pytest.raises(FaultError, match="4140"):
        bench.arm.press(CONTRACT_BENCH_PRESS)
    # Nothing is lost: with the stream the arm moves on.
    bench.rest(0.1)
    here = bench.arm.pose(0.3)
    bench.finish(bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 2.0), 20.0))


def test_an_emergency_stop_in_contact_ends_the_press(bench, controller):
    bench.lifted_and_gripped()
    motion = bench.arm.press(CONTRACT_BENCH_PRESS)
    while motion.onset_s is None:
        bench.advance(10_000)
    controller.raise_error(50)
    bench.rest(1.0)
    assert motion.done
    assert bench.arm.fault.code == "HW-STOP"


def test_the_program_that_ships_reads_what_is_written():
    text = (files("touchdown.resources") / "melfa" / "TDPROBE.prg").read_text(encoding="ascii")
    code = "\n".join(line for line in text.splitlines() if not line.startswith("'"))
    assert {name for name in WRITTEN if name in code} == set(WRITTEN)
    assert code.index("Fsc On") < code.index("Mvs PD") < code.index("Fsc Off") < code.index("End")


class Program:
    """The driver beside a force program that presses on a spring, without a bench."""

    def __init__(self) -> None:
        self.rig = rig = Rig(stiffness_mode="controller")
        self.numbers = True
        spring_n_mm, touch_mm = 8.0, 58.0

        def felt(pivot_mm):
            press_n = spring_n_mm * max(touch_mm - pivot_mm[2], 0.0)
            return np.array([0.0, 0.0, press_n if self.numbers else np.nan])

        rig.contact = felt
        rig.device.controller.felt = lambda: np.array(
            [0.0, 0.0, spring_n_mm * max(touch_mm - rig.true_mm[2], 0.0), 0.0, 0.0, 0.0]
        )
        rig.arm.connect(1.0, threading.Event())
        rig.rest(0.6)
        self.motion = rig.arm.press(CONTRACT_BENCH_PRESS)
        self.touch_mm = touch_mm

    def until_touched(self) -> None:
        while self.motion.onset_s is None:
            self.rig.rest(0.01)
        self.rig.rest(0.3)


@pytest.mark.promise("R15")
@pytest.mark.parametrize("touched", [False, True])
def test_a_wrist_without_numbers_ends_a_force_program_wherever_it_is(touched):
    program = Program()
    rig = program.rig
    if touched:
        program.until_touched()
    else:
        rig.rest(0.3)
    low_mm = rig.true_mm[2]
    program.numbers = False
    rig.rest(0.6)
    assert program.motion.done
    assert ended_by(program.motion) == "FT-STALE"
    if touched:
        # It lifts by itself once it is told to.
        assert rig.true_mm[2] > program.touch_mm + 1.0
    else:
        # Nothing but its own sensor would end its descent: it is stopped, still in the air.
        assert program.touch_mm < rig.true_mm[2] < low_mm
        assert low_mm - rig.true_mm[2] < 0.6
    stands_mm = rig.true_mm[2]
    rig.rest(1.0)
    assert rig.true_mm[2] == pytest.approx(stands_mm, abs=0.3)
    assert rig.arm.state is DeviceState.READY


@pytest.mark.promise("R15")
def test_a_cable_pulled_out_of_a_force_program_is_a_fault_and_the_program_lifts_by_itself():
    program = Program()
    rig = program.rig
    rig.rest(0.3)
    rig.wires.unplugged = rig.wires.link.cut = True
    rig.rest(2.0)
    assert program.motion.done
    assert (rig.arm.state, rig.arm.fault.code) == (DeviceState.FAULT, "ARM-LINK")
    sent = len(rig.wires.packets)
    rig.rest(CONTRACT_BENCH_PRESS.hold_s + 4.0)
    # The computer commands nothing; the controller has come to the end of its own program.
    assert len(rig.wires.packets) == sent
    assert rig.true_mm[2] == pytest.approx(program.touch_mm + 2.0, abs=0.3)
    with pytest.raises(FaultError, match="ARM-LINK"):
        rig.arm.jog((0.0, 0.0, 5.0), 0.5)


TOUCH_MM = 59.0
PRESS = PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 3.0, (30.0, 30.0, 15.0))


def ready(stiffness_n_mm, noise_n=0.1):
    rig = Rig()
    rig.noise_n = noise_n
    rig.contact = lambda pivot: np.array([0, 0, stiffness_n_mm * max(TOUCH_MM - pivot[2], 0.0)])
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.7)
    return rig


def finish(rig, motion, limit_s=6.0):
    for _ in range(round(limit_s / 0.0035)):
        if motion.done:
            return
        rig.wires.advance(3500)
    raise AssertionError("the motion does not end")


def pressed(rig, fails=""):
    """Press to the end; the press succeeds, or ``fails`` with this fault."""
    motion = rig.arm.press(PRESS)
    finish(rig, motion)
    if fails:
        assert ended_by(motion) == fails
    else:
        motion.result()
    return motion


def touching(rig, after_s=1.2):
    """Begin a press and wait until it has touched."""
    motion = rig.arm.press(PRESS)
    rig.rest(after_s)
    assert motion.onset_s is not None
    return motion


def ended_by(motion):
    with pytest.raises(FaultError) as raised:
        motion.result()
    return raised.value.fault.code


@pytest.mark.parametrize("stiffness_n_mm", [3.0, 8.0])
def test_a_press_counts_from_first_touch_and_holds_the_force_of_springs_in_series(stiffness_n_mm):
    rig = ready(stiffness_n_mm)
    motion = pressed(rig)
    press = rig.arm.poses.window(0.0, rig.wires.clock.now_s())
    touched_mm = float(np.interp(motion.onset_s, press.t_s, press.values[:, 2]))
    assert touched_mm == pytest.approx(TOUCH_MM, abs=0.1)
    steady_n = 1.5 * 15.0 * stiffness_n_mm / (15.0 + stiffness_n_mm)
    force_n = stiffness_n_mm * (TOUCH_MM - rig.true_mm[2])
    assert force_n == pytest.approx(steady_n, abs=0.15)
    assert rig.wrench.since(0).values[:, 2].max() < steady_n * 1.08 + 0.5
    unload = rig.arm.unload(1.0, 2.0)
    finish(rig, unload)
    unload.result()
    rig.rest(0.2)
    assert 0.3 <= stiffness_n_mm * (TOUCH_MM - rig.true_mm[2]) <= 2.0


def test_what_the_sensor_drifts_on_the_way_down_is_no_force_of_the_contact():
    rig = ready(8.0)
    spring = rig.contact
    drift_n = np.array([0.0, 0.0, 0.7])
    rig.contact = lambda pivot: spring(pivot) + (drift_n if pivot[2] < TOUCH_MM + 0.9 else 0.0)
    pressed(rig)
    steady_n = 1.5 * 15.0 * 8.0 / (15.0 + 8.0)
    assert 8.0 * (TOUCH_MM - rig.true_mm[2]) == pytest.approx(steady_n, abs=0.1)
    # What is told of the force counts as the tare of a run does, which is from before the descent.
    assert rig.arm._orders.level.press_n() == pytest.approx(steady_n + 0.7, abs=0.3)


@pytest.mark.promise("G5", "G6")
def test_a_contact_that_is_too_stiff_is_found_and_calmed():
    """Ten times the stiffness that the damping is made for."""
    rig = ready(300.0)
    motion = pressed(rig, fails="CONTACT-SWINGS")
    found_s = rig.wires.clock.now_s() - motion.onset_s
    assert found_s <= 12.0 * rig.arm._orders.level.loop.delay_s
    assert rig.wrench.since(0).values[:, 2].max() < 40.0
    rig.rest(1.0)
    felt = rig.wrench.window(rig.wires.clock.now_s() - 0.3, rig.wires.clock.now_s()).values[:, 2]
    assert np.ptp(felt) < 2.0


@pytest.mark.promise("G3")
def test_a_force_over_the_trip_draws_the_arm_back():
    rig = ready(8.0)
    motion = touching(rig)
    height = rig.true_mm[2]
    rig.contact = lambda pivot: np.array([0.0, 0.0, 45.0 if pivot[2] < height + 1.0 else 0.0])
    finish(rig, motion)
    assert ended_by(motion) == "FT-TRIP"
    rig.rest(1.0)
    assert rig.true_mm[2] > height + 1.0


@pytest.mark.parametrize("stiffness_n_mm", [25.0, 60.0])
def test_the_stiffness_of_the_contact_is_found_and_damped_for(stiffness_n_mm):
    rig = ready(stiffness_n_mm)
    pressed(rig)
    press = rig.arm._orders.level._press
    assert press.stiffness.found_n_mm == pytest.approx(stiffness_n_mm, rel=0.15)
    designed = 100.0 if stiffness_n_mm > 30.0 else 30.0
    wanted = damping(rig.arm._orders.level.loop.delay_s, designed)
    assert press.compliance.law.damping == pytest.approx(wanted)
    steady_n = 1.5 * 15.0 * stiffness_n_mm / (15.0 + stiffness_n_mm)
    assert stiffness_n_mm * (TOUCH_MM - rig.true_mm[2]) == pytest.approx(steady_n, abs=0.25)


def slope_of(stiffness_n_mm):
    """A contact seen as it is commanded: the force answers 20 ms later."""
    seen = ContactStiffnessEstimate(0.020)
    for k in range(600):
        t_s = 0.0035 * k
        seen.feed(t_s, -0.001 * k, max(0.0, stiffness_n_mm * 0.001 * (t_s - 0.020) / 0.0035))
    return seen.found_n_mm


def test_the_slope_is_that_of_the_spring():
    assert slope_of(200.0) == pytest.approx(200.0, rel=1e-3)
    assert slope_of(9.0) == pytest.approx(9.0, rel=1e-3)
    assert slope_of(8.0) is None


@pytest.mark.promise("G6")
@pytest.mark.parametrize("stiff_n_mm", [150.0, 200.0])
def test_a_contact_without_a_gel_is_drawn_back_from(stiff_n_mm):
    rig = ready(stiff_n_mm)
    pressed(rig, fails="CONTACT-STIFF")
    assert rig.wrench.since(0).values[:, 2].max() < 40.0
    height_mm = rig.true_mm[2]
    rig.rest(1.0)
    assert rig.true_mm[2] > height_mm + 1.0


def test_no_wrench_no_press():
    rig = ready(8.0)
    rig.wrench.clear()
    with pytest.raises(FaultError, match="FT-STALE"):
        rig.arm.press(PRESS)
    with pytest.raises(FaultError, match="NOT-PRESSING"):
        rig.arm.unload(1.0, 2.0)


@pytest.mark.parametrize("speed_mm_s", [13.0, 0.0])
def test_an_approach_that_could_trip_is_refused(speed_mm_s):
    rig = ready(8.0)
    with pytest.raises(RefusedError, match="APPROACH-SPEED"):
        rig.arm.press(replace(PRESS, approach_mm_s=speed_mm_s))
    before = rig.true_mm[2]
    rig.rest(0.1)
    assert rig.true_mm[2] == pytest.approx(before, abs=1e-3)


@pytest.mark.promise("P1")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, 1e308])
def test_a_press_with_a_senseless_number_cannot_be_made(bad):
    for name in ("depth_mm", "ramp_s", "hold_s", "approach_mm_s", "threshold_n", "max_travel_mm"):
        with pytest.raises(ValueError, match=name):
            replace(PRESS, **{name: bad})
    with pytest.raises(ValueError, match="stiffness_n_mm"):
        replace(PRESS, stiffness_n_mm=(30.0, bad, 15.0))


@pytest.mark.promise("S7")
def test_the_arm_stands_while_the_wrench_is_no_number():
    rig = ready(8.0)
    touching(rig)
    rig.contact = lambda pivot: np.full(3, np.nan)
    rig.rest(0.15)
    give = rig.arm.describe()["z_mm"] - rig.arm._orders.level._press.compliance.reference_mm[2]
    rig.rest(0.1)
    after = rig.arm.describe()["z_mm"] - rig.arm._orders.level._press.compliance.reference_mm[2]
    assert after == pytest.approx(give, abs=1e-9)


def swing(amplitude_n, period_s, delay_s=0.0237, lasts_s=1.0):
    detector = OscillationDetector(delay_s)
    times = np.arange(0.0, lasts_s, 0.0035)
    return [t for t in times if detector.feed(t, amplitude_n * np.sin(2 * np.pi * t / period_s))]


@pytest.mark.promise("G5")
def test_the_detector_knows_a_swing_from_a_press():
    assert swing(1.0, 0.142)[0] < 0.4
    assert swing(0.45, 0.142) == []
    assert swing(1.0, 0.5) == []
    detector = OscillationDetector(0.0237)
    ramp = np.linspace(0.0, 20.0, 300)
    noise = np.random.default_rng(1).normal(0.0, 0.1, 300)
    assert not any(detector.feed(0.0035 * k, f) for k, f in enumerate(ramp + noise))


@pytest.mark.promise("S6")
def test_a_wrist_that_falls_silent_on_the_way_down_ends_the_descent():
    rig = ready(8.0)
    motion = rig.arm.press(PRESS)
    rig.rest(0.2)
    rig.wires.also = rig.wires.clock.advance
    silent_s, here_mm = rig.wires.clock.now_s(), rig.true_mm[2]
    finish(rig, motion)
    assert ended_by(motion) == "FT-STALE"
    assert rig.wires.clock.now_s() - silent_s <= 0.105
    rig.rest(0.3)
    assert here_mm - rig.true_mm[2] == pytest.approx(0.2, abs=0.05)


@pytest.mark.promise("S4")
def test_in_contact_the_arm_stands_without_a_wrench_and_then_draws_back():
    rig = ready(8.0)
    motion = touching(rig)
    rig.wires.also = rig.wires.clock.advance
    silent_s = rig.wires.clock.now_s()
    finish(rig, motion)
    assert ended_by(motion) == "FT-STALE"
    assert rig.wires.clock.now_s() - silent_s <= 0.105
    rig.rest(0.05)
    stood_mm = rig.true_mm[2]
    rig.rest(0.1)
    assert rig.true_mm[2] == pytest.approx(stood_mm, abs=0.01)
    rig.rest(0.6)
    assert rig.true_mm[2] == pytest.approx(stood_mm + 2.0, abs=0.05)


STATE, STOP, OVERRIDE = R3Request("STATE"), R3Request("STOP"), R3Request("OVRD")


@pytest.fixture
def client():
    return R3Client(0.03)


def step(client, *came):
    """Give the client (time, bytes) in turn; return what it sent each time."""
    return [client.step(now_s, data) for now_s, data in came]


def test_one_request_is_on_the_wire_at_a_time(client):
    first, second = client.ask(STATE), client.ask(OVERRIDE)
    sent = step(client, (0.0, b""), (0.01, b""), (0.02, b"QoKa\r"))
    assert sent == [b"1;1;STATE\r", b"", b"1;1;OVRD\r"]
    assert (first.answer, second.done()) == ("a", False)
    client.step(0.03, b"QoK50\r\n")
    assert second.answer == "50"


@pytest.mark.promise("R10")
def test_replies_may_be_split_merged_or_without_an_end(client):
    tickets = [client.ask(OVERRIDE) for _ in range(3)]
    step(client, (0.0, b""), (0.001, b"Qo"), (0.002, b"K10\rQo"), (0.003, b"K20\r"))
    assert [t.done() for t in tickets] == [True, True, False]
    client.step(0.004, b"QoK30")
    assert not tickets[2].done()
    client.step(0.040, b"")
    assert [t.answer for t in tickets] == ["10", "20", "30"]


def test_stop_goes_before_what_is_not_yet_sent_and_keeps_no_distance(client):
    client.paced = True
    client.ask(STATE)
    client.step(0.0, b"")
    client.ask(OVERRIDE)
    client.ask(STOP)
    sent = step(client, (0.01, b"QoKa\r"), (0.02, b"QoK\r"), (0.11, b""), (0.121, b""))
    assert sent == [b"1;1;STOP\r", b"", b"", b"1;1;OVRD\r"]


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
    step(client, (0.0, b""), (1.5, b""))
    with pytest.raises(FaultError, match="ARM-LINK"):
        client.step(3.0, b"")
    assert all(ticket.done() for ticket in tickets)
    after = client.ask(STATE)
    assert after.done()
    with pytest.raises(FaultError):
        _ = after.answer


@pytest.mark.parametrize(
    ("data", "stranger", "said"),
    [
        (b"", "", "silent for 3 s"),
        (b"\x00\xff nonsense\r", "", "not an answer of a controller"),
        (b"\xaa\xaa\xaa\x40 without an end", "", "not an answer of a controller"),
        (b"0200020002000\r\n", "a Dynpick sensor", "This is a Dynpick sensor, expected a MELFA"),
    ],
)
def test_silence_nonsense_and_another_device_are_told_apart(data, stranger, said, caplog):
    client = R3Client(0.03, lambda: stranger)
    caplog.set_level("INFO")
    for now_s in (0.0, 0.5, 0.6):
        client.ask(STATE, 60.0)
        client.step(now_s, data if now_s else b"")
    with pytest.raises(FaultError, match=said) as raised:
        client.step(3.0, b"")
    assert data[:4].hex(" ") not in str(raised.value) or not data
    assert bool(caplog.records) is (bool(data) and not stranger)
    assert not caplog.records or data[:4].hex(" ") in caplog.text


def test_a_controller_that_answered_once_is_never_asked_who_it_is():
    client = R3Client(0.03, lambda: "a gripper")
    client.ask(STATE)
    step(client, (0.0, b""), (0.1, b"QoKa\r"))
    client.ask(STATE, 60.0)
    client.step(0.2, b"")
    with pytest.raises(FaultError, match="silent"):
        client.step(3.3, b"")


def test_silence_counts_only_while_something_is_owed(client):
    ticket = client.ask(STATE)
    step(client, (0.0, b""), (0.1, b"QoKa\r"), (60.0, b""))
    assert ticket.answer == "a"


def test_garbage_is_counted_and_answers_nothing(client):
    ticket = client.ask(STATE)
    step(client, (0.0, b""), (0.1, b"\x00\xff?\rnonsense\r"))
    assert client.bad_replies == 2
    assert not ticket.done()
    client.step(0.2, b"QoKa\r")
    assert ticket.answer == "a"


def test_a_refusal_is_a_fault_with_its_number(client):
    ticket = client.ask(STATE)
    step(client, (0.0, b""), (0.1, b"QeR6020\r"))
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
