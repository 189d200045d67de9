"""Sessions as a script uses them: open a bench, run a request, read the result."""

import shutil
import threading
from contextlib import nullcontext
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.bench.brisk import brisk_method, brisk_session, brisk_settings
from tests.backend.rig.scripted import scripted
from touchdown.backend.bench import RunResult, open_lab, simulated_bench
from touchdown.backend.core.events import BeliefUpdated, EpisodeRecorded, TrialFinished
from touchdown.backend.core.faults import Fault, FaultError, InputError, RefusedError
from touchdown.backend.core.values import Outcome
from touchdown.backend.runs.event_log import read_events
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import ProbeRequest, SceneChoice, SetRequest, StackRequest

REQUEST = StackRequest(piece="pot", bottoms=("short",), strategy="fused", seed=7)


@pytest.fixture(autouse=True)
def _own_data_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TOUCHDOWN_DATA", str(tmp_path / "data"))


def brisk():
    return simulated_bench(settings=brisk_settings(), method=brisk_method())


def test_a_script_runs_a_request_and_reads_its_trials():
    with simulated_bench() as bench:
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


def test_a_piece_without_a_model_is_served_by_the_network_of_fused(tmp_path) -> None:
    folder = tmp_path / "pieces"
    folder.mkdir()
    barrel = str(files("touchdown.resources") / "objects" / "barrel.toml")
    (folder / "keg.toml").write_text(
        Path(barrel).read_text().replace("21.2", "19.0").replace("Barrel", "Keg")
    )
    method = brisk_method()
    with simulated_bench(settings=brisk_settings(), method=method, pieces=folder) as bench:
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
