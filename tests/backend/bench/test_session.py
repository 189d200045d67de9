"""Sessions as a script uses them: open a bench, run a request, read the result."""

import math
import re
import shutil
import socket
import sys
import threading
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from tests.backend.bench.brisk import brisk_method, brisk_session, brisk_settings
from tests.backend.exchange.conftest import seen_episode
from tests.backend.rig.scripted import scripted
from touchdown.backend.bench import (
    LiveView,
    RunResult,
    SimulatedBenchChoice,
    live_view,
    open_lab,
    serve_live,
    simulated_bench,
    simulated_session,
)
from touchdown.backend.config import SimulationSettings
from touchdown.backend.config.bench_description import describe_simulation
from touchdown.backend.core import EventBus
from touchdown.backend.core.events import BeliefUpdated, EpisodeRecorded, TrialFinished
from touchdown.backend.core.faults import Fault, FaultError, InputError, RefusedError
from touchdown.backend.core.values import BeliefMap, Outcome
from touchdown.backend.episodes import (
    FACTS_KEY,
    LIVE_TOPICS,
    read_whole,
    unpack_json,
    write_episode,
)
from touchdown.backend.runs.event_log import read_events
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import (
    CalibrateRequest,
    CollectRequest,
    ProbeRequest,
    SceneChoice,
    SetRequest,
    StackRequest,
)

REQUEST = StackRequest(piece="pot", bottoms=("short",), strategy="fused", seed=7)


@pytest.fixture(autouse=True)
def _own_data_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TOUCHDOWN_DATA", str(tmp_path / "data"))


def brisk():
    return simulated_bench(settings=brisk_settings(), method=brisk_method())


def test_a_script_runs_a_request_and_reads_its_trials():
    with brisk() as bench:
        result = bench.run(REQUEST)
    (trial,) = result.trials
    assert (trial.outcome, trial.seed, result.ending) == (Outcome.PLACED, 7, "finished")
    assert trial.probes >= 1
    assert trial.margin_mm > 0.0
    assert result.faults == ()
    assert result.run_folder is None


def test_the_result_holds_the_published_trials_and_the_folder(tmp_path):
    published = []
    with simulated_bench(
        settings=brisk_settings(), method=brisk_method(), runs=tmp_path / "runs"
    ) as bench:
        leave = bench.events.subscribe(published.append)
        result = bench.run(StackRequest(strategy="pick-and-place", seed=7, trials=2))
        leave()
        bench.run(SetRequest(SceneChoice(estimates=False)))
    trials = tuple(event for event in published if isinstance(event, TrialFinished))
    assert result.trials == trials
    assert [trial.seed for trial in trials] == [7, 8]
    assert result.run_folder.parent == tmp_path / "runs"
    assert [e for e in read_events(result.run_folder) if isinstance(e, TrialFinished)] == [*trials]


def test_requests_without_trials_have_an_empty_result():
    with brisk() as bench:
        assert bench.run(SetRequest(SceneChoice(estimates=False))) == RunResult()
        probe = bench.run(ProbeRequest())
    assert (probe.trials, probe.ending, probe.reason) == ((), "finished", "The probe is done.")


def test_the_episode_of_a_probe_is_kept(tmp_path):
    session = brisk_session(keep=RecordingOptions(tmp_path))
    with session as bench:
        bench.run(SetRequest(SceneChoice(estimates=False)))
        folder = bench.run(ProbeRequest()).run_folder
    (recorded,) = [e for e in read_events(folder) if isinstance(e, EpisodeRecorded)]
    assert (folder / "episodes" / recorded.path).is_file()


def test_every_picture_of_a_run_is_tracked_and_every_third_of_an_idle_bench():
    with simulated_bench(preset="quiet") as bench:
        bench.run(SetRequest(SceneChoice(estimates=False)))
        bench.run(ProbeRequest())
        end_s = bench.clock_s()
        run = bench.recording(end_s - 5.0, end_s)
        for _ in range(100):
            bench.advance()
        idle = bench.recording(end_s + 0.5, bench.clock_s())
    assert len(run.fields) == len(run.frames) > 200
    assert len(idle.fields) / len(idle.frames) == pytest.approx(1 / 3, abs=0.1)


def advanced_us(bench, steps):
    """Return the steps in which a live bench advances."""
    taken, advance = [], bench.advance
    bench.advance = lambda: taken.append(bench._step_us) or advance()
    for _ in range(steps):
        bench._live_step()
    bench.advance = advance
    return taken


def test_a_live_simulation_at_rest_takes_longer_steps_until_something_moves():
    with simulated_bench(preset="quiet") as bench:
        assert advanced_us(bench, 2) == [20_000, 20_000], "no scene yet"
        bench.run(SetRequest(SceneChoice(estimates=False)))
        begun_s = bench.clock_s()
        assert advanced_us(bench, 13) == [100_000, 100_000]
        bench.hand.grip(10.0)
        assert advanced_us(bench, 2) == [20_000] * 5, "the time owed is made up"
        assert bench.clock_s() == pytest.approx(begun_s + 0.3)
        advanced_us(bench, 50)
        assert bench.hand.holding
        assert advanced_us(bench, 5) == [20_000] * 5, "a held piece may be lost"
    failing = simulated_session(SimulatedBenchChoice(disturbances=("force_torque:stop@9",)))
    with failing as bench:
        bench.prepare(SceneChoice())
        assert advanced_us(bench, 5) == [20_000] * 5, "what fails is noticed in time"


def test_pictures_that_nobody_watches_are_tracked_twice_a_second():
    with simulated_bench(preset="quiet") as bench:
        bench.run(SetRequest(SceneChoice(estimates=False)))
        shares = []
        for bench.watched, bench.served in ((True, False), (False, False), (False, True)):
            for _ in range(50):
                bench.advance()
            begun_s = bench.clock_s()
            for _ in range(100):
                bench.advance()
            new = bench.recording(begun_s, bench.clock_s())
            shares.append(len(new.fields) / len(new.frames))
            assert sum(frame.made for frame in new.frames) <= len(new.fields) + 1
    assert shares == pytest.approx([1 / 3, 1 / 13, 1 / 3], abs=0.04)


def test_a_cancelled_run_returns_what_it_has():
    with brisk() as bench:
        cancel = bench.engine.cancel
        bench.events.subscribe(lambda e: cancel() if isinstance(e, TrialFinished) else None)
        result = bench.run(StackRequest(strategy="pick-and-place", trials=3))
        assert not bench.interlock.latched
    assert (len(result.trials), result.ending, result.faults) == (1, "cancelled", ())


def test_a_run_cancelled_while_its_devices_connect_is_no_fault(monkeypatch):
    lost = FaultError(Fault("FT-LINK", "The sensor does not answer.", "Nothing moved.", "Look."))

    with brisk() as bench:

        def connecting(*_scene):
            bench.engine.cancel()
            assert bench.engine.cancelled.is_set()
            raise lost

        monkeypatch.setattr(bench, "_make_stage", connecting)
        result = bench.run(StackRequest(strategy="pick-and-place"))
        assert not bench.interlock.latched
    assert (result.ending, result.reason) == ("cancelled", "cancelled by the operator")
    assert result.faults == ()


def test_bad_requests_and_settings_are_refused():
    with brisk() as bench, pytest.raises(InputError, match="teapot"):
        bench.run(StackRequest(piece="teapot"))
    with pytest.raises(InputError, match="preset"):
        simulated_bench(preset="loud")
    with pytest.raises(InputError, match=r"no\.toml"):
        simulated_bench(settings="no.toml")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"strategy": "fuse"}, "no strategy 'fuse'.*Use one of: paper,"),
        ({"mode": "careful"}, "no mode 'careful'.*Use one of: auto,"),
        ({"bottoms": "short"}, r"bottoms.*such as \('short',\)"),
        ({"trials": 0}, "0 trials"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": 0.5}, "seed is 0.5.*whole number"),
        ({"origin_mm": (math.nan, 0.0)}, r"origin is \(nan, 0.0\)"),
        ({"origin_mm": (1e9, 0.0)}, "origin is"),
    ],
)
def test_a_misspelt_request_is_refused_before_it_runs_as_another_one(values, said) -> None:
    with pytest.raises(InputError, match=said):
        StackRequest(**values)


@pytest.mark.parametrize(
    "values",
    [
        {"pattern": "spiral"}, {"seed": -1}, {"origin_mm": (0.0, math.inf)}, {"count": 0},
        {"depth_mm": math.nan}, {"depth_mm": -1.0}, {"depth_mm": 1e9}, {"ramp_fraction": 1.0},
        {"grip_force_n": math.nan}, {"grip_force_n": 0.0}, {"grip_force_n": 1e9},
        {"within_mm": -1.0}, {"within_mm": 0.0}, {"rest_s": math.inf},
        {"origin_sigma_mm": math.nan},
        {"probes_per_grip": 0}, {"grips_per_mounting": 0}, {"stage": "gal"},
    ],
)  # fmt: skip
def test_a_campaign_with_an_impossible_number_is_refused_before_the_arm_moves(values) -> None:
    """These numbers enter the settings of the press, which are not validated again."""
    ((name, _),) = values.items()
    with pytest.raises(InputError, match=name.removesuffix("_mm").split("_")[0]) as refused:
        CollectRequest(**values)
    assert refused.value.fix
    assert CollectRequest(depth_mm=np.float64(2.0), rest_s=1).rest_s == 1


def test_a_calibration_without_a_place_of_its_bottom_is_refused() -> None:
    with pytest.raises(InputError, match="origin is"):
        CalibrateRequest("board", origin_mm=(0.0, math.nan))


def test_a_piece_without_a_model_is_served_by_the_network_of_fused(tmp_path) -> None:
    folder = tmp_path / "pieces"
    folder.mkdir()
    barrel = str(files("touchdown.resources") / "objects" / "barrel.toml")
    (folder / "keg.toml").write_text(
        Path(barrel).read_text().replace("21.2", "19.0").replace("Barrel", "Keg")
    )
    method = brisk_method()
    with simulated_bench(settings=brisk_settings(), method=method, pieces=str(folder)) as bench:
        with pytest.raises(InputError, match="No model ships for piece 'keg'"):
            bench.run(StackRequest(piece="keg", seed=7))
        maps = []
        bench.events.subscribe(lambda e: maps.append(e) if isinstance(e, BeliefUpdated) else None)
        result = bench.run(StackRequest(piece="keg", strategy="fused", seed=7))
    assert [trial.outcome for trial in result.trials] == [Outcome.PLACED]
    # The map shows what the network says, not the patches that no model estimates.
    assert np.ptp(maps[-1].belief.log_odds) > 1.0


def test_a_strategy_trained_with_convex_outlines_refuses_others_before_anything_moves():
    with brisk() as bench:
        before = bench.clock_s()
        with pytest.raises(InputError, match="'ring24' has holes, notches or several parts"):
            bench.run(StackRequest(bottoms=("ring24",), strategy="fused"))
        assert bench.clock_s() == before


def test_a_piece_is_placed_on_a_ring():
    with brisk() as bench:
        result = bench.run(StackRequest(bottoms=("ring24",), strategy="pick-and-place", seed=7))
    (trial,) = result.trials
    assert trial.outcome in (Outcome.PLACED, Outcome.FELL)
    assert (trial.outcome is Outcome.PLACED) == (trial.margin_mm > 0.0)


@pytest.mark.parametrize(
    ("key", "value", "limit"),
    [
        ("travel_mm_s", 200.0, "speed_mm_s"),
        ("approach_mm_s", 5.0, "contact_speed_mm_s"),
        ("depth_mm", 4.0, "probe_n"),
    ],
)
def test_a_method_beyond_the_limits_is_refused_before_anything_moves(key, value, limit) -> None:
    method = brisk_method()
    method = method.model_copy(update={"probe": method.probe.model_copy(update={key: value})})
    with simulated_bench(settings=brisk_settings(), method=method) as bench:
        with pytest.raises(InputError, match=key) as raised:
            bench.check(REQUEST)
        assert limit in raised.value.fix


def test_a_grip_force_beyond_the_gripper_is_refused_before_anything_moves(monkeypatch) -> None:
    with brisk() as bench:
        for most_n, refused in ((8.0, True), (20.0, False)):
            gripper = SimpleNamespace(describe=lambda most_n=most_n: {"most_force_n": most_n})
            monkeypatch.setattr(type(bench), "devices", {"gripper": gripper})
            with pytest.raises(InputError, match="grip_force_n") if refused else nullcontext():
                bench.check(REQUEST)


def test_leaving_the_block_stops_the_live_thread():
    with brisk() as bench:
        bench.open()
        assert any(thread.name == "bench" for thread in threading.enumerate())
    assert not any(thread.name == "bench" for thread in threading.enumerate())


def test_a_lab_is_opened_without_connecting_and_connects_when_asked(tmp_path):
    path = tmp_path / "lab.toml"
    template = files("touchdown.resources") / "benches" / "lab.toml"
    shutil.copy(str(template), path)
    with open_lab(path) as bench:
        assert not bench.simulated
        assert len(bench.connection.missing()) == 5
        assert bench.hand is None
        with pytest.raises(RefusedError, match="NOT-CONNECTED"):
            bench.run(REQUEST)
        devices, log = scripted()
        bench.connection.devices.update(devices)
        bench.connection.prove = lambda name, cancel: None
        bench.connection.when_ready = lambda: None
        bench.connect()
        assert bench.connection.missing() == ()
        assert log.count("connect arm") == 1
        devices["arm"].close()
        devices["arm"].fails_at = "identify"
        with pytest.raises(FaultError, match="arm: identify"):
            bench.connect()


def stalled_run(folder, publish):
    """Run a seeded trial with a live view; return the lines of the event log and the view."""
    given = {"settings": brisk_settings(), "method": brisk_method()}
    with simulated_bench(**given, runs=str(folder)) as bench:
        view = None if publish is None else LiveView(bench, publish, lambda topic: True)
        result = bench.run(StackRequest(strategy="pick-and-place", seed=7))
        if view is not None:
            view.close()
    folder = result.run_folder
    lines = (folder / "journal.jsonl").read_text().replace(folder.name, "").splitlines()
    return [line for line in lines if '"RunStarted"' not in line], view


def test_a_stalled_live_view_changes_no_event(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(live_view, "CLOSE_S", 0.0)
    monkeypatch.setattr(live_view, "MOST_EVENTS", 4)
    free, stalled = threading.Event(), threading.Event()

    def publish(topic, log_ns, message):
        stalled.set()
        free.wait(60.0)

    alone, _ = stalled_run(tmp_path / "alone", None)
    shown, view = stalled_run(tmp_path / "shown", publish)
    free.set()
    view._thread.join(10.0)
    assert stalled.is_set()
    assert shown == alone
    assert view.events.dropped > 0
    assert f"left out {view.events.dropped} events" in caplog.text


def test_a_live_view_that_shows_everything_logs_nothing(caplog):
    session = SimpleNamespace(
        events=EventBus(), description=describe_simulation(SimulationSettings()),
        clock_s=lambda: 60.0, recording=lambda start_s, end_s: read.set(),
    )  # fmt: skip
    read = threading.Event()
    view = LiveView(session, lambda *message: None, lambda topic: True)
    assert read.wait(10.0)
    view.close()
    assert view.skipped_s == 0.0
    assert "left out" not in caplog.text


def replace_sdk(monkeypatch, stop):
    """Put a server in place of the Foxglove SDK, which serves nothing and stops by ``stop``."""
    channel = SimpleNamespace(log=None, has_sinks=lambda: False)
    sdk = SimpleNamespace(
        Context=object, Schema=lambda **_: None, Channel=lambda *_, **__: channel,
        start_server=lambda **_: SimpleNamespace(port=1, stop=stop),
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "foxglove", sdk)


def test_a_client_that_says_nothing_does_not_keep_the_bench_open(monkeypatch):
    free, ended = threading.Event(), []
    replace_sdk(monkeypatch, lambda: ended.append(free.wait(30.0)))
    monkeypatch.setattr(live_view, "CLOSE_S", 0.1)
    with brisk() as bench:
        serve_live(bench)
    assert ended == []
    free.set()


@pytest.mark.parametrize(
    ("address", "risk"),
    [("127.0.0.1:1", False), ("[::1]:1", False), ("localhost:1", False), ("0.0.0.0:1", True),
     ("192.168.0.5:1", True)],
)  # fmt: skip
def test_an_address_beyond_this_computer_names_its_risk(monkeypatch, address, risk):
    replace_sdk(monkeypatch, lambda: None)
    with brisk() as bench:
        assert ("there is no password" in serve_live(bench, address)) == risk


def test_the_live_view_has_the_topics_and_types_of_a_recording(tmp_path):
    episode, sent, complete = seen_episode(0), {}, threading.Event()
    times = [episode.onset_s - 0.3]  # of the clock; it stands in the end
    session = SimpleNamespace(
        events=EventBus(), description=describe_simulation(SimulationSettings()),
        clock_s=lambda: times.append(times[-1] + 0.15 * (len(times) < 20)) or times[-1],
        recording=lambda start_s, end_s: part_of(episode.recording, start_s, end_s),
    )  # fmt: skip

    def publish(topic, log_ns, message):
        sent.setdefault(topic.name, []).append(message)
        if {"/belief", "/tac/left/image", "/tac/left/points"} <= set(sent):
            complete.set()

    view = LiveView(session, publish, lambda topic: True)
    session.events.publish(EpisodeRecorded(0.0, replace(episode, recording=None), 1, ""))
    belief = BeliefMap(np.log([[3.0, 1.0]]), np.array([[True, False]]), (1.0, 2.0), 2.0, 1)
    session.events.publish(BeliefUpdated(0.0, belief, 1))
    assert complete.wait(10.0)
    view.close()
    facts = session.description.model_dump_json()
    write_episode(tmp_path / "e.mcap", episode, None, {FACTS_KEY: facts})
    recorded = read_whole(tmp_path / "e.mcap").messages
    assert set(sent) - {"/belief"} == {
        topic for topic in recorded if topic != "/obs" and not topic.startswith("/scene")
    }
    for topic in set(sent) & {"/ft/tared", "/robot/pose", "/tf", "/tac/left/markers"}:
        assert set(sent[topic]) <= {bytes(message) for message in recorded[topic]}, topic
    assert unpack_json(sent["/episode/event"][0])["event"] == "EpisodeRecorded"


HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)


def test_foxglove_is_told_every_topic(monkeypatch):
    pytest.importorskip("foxglove")
    monkeypatch.setattr(live_view, "CLOSE_S", 0.1)
    with ExitStack() as clients:
        with brisk() as bench:
            port = int(serve_live(bench, "127.0.0.1:0").rstrip(".").rpartition(":")[2])
            silent, client = (
                clients.enter_context(socket.create_connection(("127.0.0.1", port), 10.0))
                for _ in range(2)
            )
            client.sendall(HANDSHAKE)
            told = b""
            while not all(f'"{topic.name}"'.encode() in told for topic in LIVE_TOPICS):
                told += client.recv(1 << 16)
        assert silent.fileno() > 0  # it has never said anything, and the bench is closed
    while any(end.laddr.port == port for end in psutil.Process().net_connections()):
        threading.Event().wait(0.05)  # the SDK closes its sockets later


def test_the_layout_for_foxglove_shows_topics_that_are_served():
    layout = (files("touchdown.resources") / "foxglove" / "touchdown.json").read_text("utf-8")
    shown = set(re.findall(r'"(/[a-z/_]+)[".]', layout))
    assert len(shown) >= 8
    assert shown <= {topic.name for topic in LIVE_TOPICS}


def test_a_live_view_that_cannot_be_served_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    for address, fix in (("127.0.0.1:0", r"touchdown\[live\]"), ("nowhere", "HOST:PORT")):
        with pytest.raises(InputError) as error:
            serve_live(SimpleNamespace(), address)
        assert re.search(fix, error.value.fix)


def part_of(recording, start_s, end_s):
    """The samples of a recording between two times."""
    cut = {}
    for name in ("wrench", "pose", "command"):
        t_s = getattr(recording, f"{name}_t_s")
        kept = (t_s >= start_s) & (t_s <= end_s)
        values = name if name == "wrench" else f"{name}_mm"
        cut |= {f"{name}_t_s": t_s[kept], values: getattr(recording, values)[kept]}
    for name in ("fields", "frames"):
        cut[name] = tuple(f for f in getattr(recording, name) if start_s <= f.t_s <= end_s)
    return replace(recording, scene=(), **cut)
