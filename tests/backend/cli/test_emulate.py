"""``touchdown emulate``: a device for others to speak to, and what it says of itself."""

from __future__ import annotations

import errno
import io
import json
import os
import queue
import socket
import threading
import time
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.table import Table

from touchdown.backend import bench, rig
from touchdown.backend.cli import emulate, main
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.cli.settings import as_toml, load_method
from touchdown.backend.cli.stack import trial_table
from touchdown.backend.config import HardwareSettings, StackSettings, load_lab, read_settings
from touchdown.backend.core import Outcome, TrialFinished
from touchdown.backend.devices import emulated_makes, make_force_torque
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.protocol import WsgCommand, WsgRequest
from touchdown.backend.emulation import TcpServer, add_noise
from touchdown.backend.rig.connection import BenchConnection
from touchdown.backend.runs.event_log import EVENT_LOG_NAME


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


@pytest.mark.parametrize("kind", sorted(emulated_makes()))
def test_every_kind_serves_and_tells_its_bench_file(kind, capsys, tmp_path):
    folder = ["--folder", str(tmp_path)] if kind == "gelsight" else []
    assert main(["emulate", kind, *folder, "--for", "0.02", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["kind"] == kind
    assert told["address"]
    assert told["bench"]


@pytest.fixture
def ends(monkeypatch):
    """Where each ``emulate`` puts what its Ctrl-C would call: it serves until a test calls it."""
    told = queue.SimpleQueue()

    @contextmanager
    def handed_over(screen, cancel):
        told.put(cancel)
        yield

    monkeypatch.setattr(emulate.VerbOutput, "ctrl_c_cancels", handed_over)
    return told


def test_a_client_of_its_own_reads_the_gripper(capsys, ends):
    port = free_port()
    words = ["emulate", "wsg", "--port", str(port), "--part", "0", "--json"]
    serving = threading.Thread(target=main, args=(words,))
    serving.start()
    replies, reader = [], protocol.replies()
    end = ends.get(timeout=60.0)
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=60.0) as client:
            client.sendall(protocol.encode_request(WsgRequest(WsgCommand.WIDTH, (0, 0))))
            while not replies:
                heard = client.recv(100)
                assert heard, "it closed the wire without an answer"
                replies.extend(reader.feed(heard))
    finally:
        end()
        serving.join()
    assert replies[0].values == (66.0,)
    told = json.loads(capsys.readouterr().out)
    assert (told["clients"], told["bench"]["wsg"]["port"]) == (1, port)
    assert told["received_bytes"] == 11


@pytest.mark.parametrize("kind", ["melfa", "wsg", "dynpick", "netft"])
def test_a_device_on_every_network_warns_and_tells_an_address_for_others(kind, capsys, monkeypatch):
    monkeypatch.setattr(emulate, "own_address", lambda: "192.0.2.7")
    words = ["emulate", kind, "--host", "0.0.0.0", "--port", str(free_port()), "--for", "0.02"]
    assert main(words) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "listens on every network of this computer" in told
    assert "192.0.2.7" in told.partition("In a bench file:")[2]
    assert "0.0.0.0" not in told
    assert main([*words, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert "0.0.0.0" not in json.dumps(result)
    assert "192.0.2.7" in json.dumps(result["bench"])


@pytest.mark.parametrize(
    "words",
    [
        ["wsg", "--tty", "x"],
        ["dynpick", "--tty", "x", "--port", "5000"],
        ["dynpick", "--load", "1,2"],
        ["dynpick", "--port", "0"],
        ["dynpick", "--for", "nan"],
        ["gelsight"],
        ["wsg", "--lab-file", "lab.toml", "--for", "0.02"],
        ["wsg", "--jig", "--for", "0.02"],
        ["bench", "--folder", "new", "--port", "5000", "--for", "0.02"],
        ["toaster"],
        ["bench"],
    ],
)
def test_bad_words_are_bad_input(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["emulate", *words]) == 2
    assert "fix:" in capsys.readouterr().err
    assert main(["stack", "--emulated", "--inject", "arm:freeze@1"]) == 2


def test_a_folder_named_from_here_leads_to_the_bench_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["emulate", "bench", "--folder", "new", "--lab-file", "new/lab.toml", "--for", "0.02"]
    assert main(words) == 0
    lab = load_lab(tmp_path / "new" / "lab.toml")
    assert lab.settings.ft.address == str(tmp_path / "new" / "force_torque")
    assert Path(lab.settings.gelsight.by_id).parent == (tmp_path / "new").resolve()


def test_a_lab_file_of_devices_is_not_replaced(tmp_path, capsys):
    lab = tmp_path / "lab.toml"
    assert main(["bench", str(lab), "--new"]) == 0
    before = lab.read_bytes()
    words = ["emulate", "bench", "--lab-file", str(lab), "--for", "0.02"]
    assert main(words) == 2
    assert "would be replaced" in capsys.readouterr().err
    assert lab.read_bytes() == before
    lab.unlink()
    assert main(words) == main(words) == 0


def test_a_bench_leaves_its_file_in_the_folder(tmp_path, capsys):
    assert main(["emulate", "bench", "--folder", str(tmp_path), "--for", "0.02", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["seen"]["step_share"] == 0.0
    told = result["bench"]
    hardware = read_settings(HardwareSettings, tmp_path / "bench.toml")
    assert hardware.ft.address == told["ft"]["address"]
    assert hardware.wsg.port == told["wsg"]["port"]
    words = ["emulate", "bench", "--folder", str(tmp_path), "--for", "0.02"]
    assert main(words) == 0, "its own file is replaced"
    file = tmp_path / "bench.toml"
    for other in ("[grasp]\nslip = false\n", file.read_text("utf-8") + "mm_per_px_x = 0.05\n", "?"):
        file.write_text(other, "utf-8")
        capsys.readouterr()
        assert main(words) == 2
        assert str(file) in capsys.readouterr().err
        assert file.read_text("utf-8") == other


def _screen(*, as_json):
    stream = io.StringIO()
    return VerbOutput(json=as_json, stream=stream), stream


def test_scripts_get_one_object_and_nothing_else():
    screen, stream = _screen(as_json=True)
    screen.say("words")
    screen.show(Table(title="a table"))
    with screen.progress("Working", 3) as advance:
        advance(1, "one")
        advance(3)
    with screen.status() as show:
        show(Table(title="changing"))
    screen.result({"done": True})
    assert json.loads(stream.getvalue()) == {"version": 1, "done": True}
    assert stream.getvalue().count("\n") == 1
    with pytest.raises(RuntimeError, match="exactly one"):
        screen.result({})


def test_people_get_whole_sentences_titles_of_bars_and_no_object():
    screen, stream = _screen(as_json=False)
    screen.say("Estimate [0.5, 1.0] mm" + " word" * 100)
    with screen.progress("Training", 10) as advance:
        advance(5, "half")
    screen.result({"done": True})
    assert stream.getvalue() == f"Estimate [0.5, 1.0] mm{' word' * 100}\nTraining ...\n"
    screen.table("title", ["reason"], ["arm refused [/busy] [BUSY]"])
    assert "arm refused [/busy] [BUSY]" in stream.getvalue()


def test_numbers_that_json_lacks_become_null():
    screen, stream = _screen(as_json=True)
    screen.result(
        {
            "nan": float("nan"),
            "deep": [{"inf": float("inf")}, (1, np.float64("nan"))],
            "numpy": [np.float32(0.5), np.int64(3), np.bool_(True)],
        }
    )
    assert json.loads(stream.getvalue()) == {
        "version": 1,
        "nan": None,
        "deep": [{"inf": None}, [1, None]],
        "numpy": [0.5, 3, True],
    }


def test_what_is_written_is_read_back_the_same(tmp_path, capsys) -> None:
    path = tmp_path / "method.toml"
    assert main(["settings", "--write", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["method"]["stability"]["delta"] == 0.9
    assert told["written"] == str(path)
    assert load_method(path) == StackSettings()
    changed = path.read_text("utf-8").replace("[30.0, 30.0, 15.0]", "[20, 20.0, 1e1]")
    path.write_text(changed.replace('"area"', '"cells"').replace("false", "true"), "utf-8")
    settings = load_method(path)
    assert settings.probe.stiffness_n_mm == (20.0, 20.0, 10.0)
    assert (settings.policy.hull_centre, settings.belief.prior_correction) == ("cells", True)
    again = tmp_path / "again.toml"
    again.write_text(as_toml(settings), "utf-8")
    assert load_method(again) == settings
    assert main(["settings", "--write", str(again), "--json"]) == 2
    assert json.loads(capsys.readouterr().err)["error"]["where"] == str(again)
    assert load_method(again) == settings, "a file is never written over"


def test_a_file_that_does_not_fit_on_the_disk_leaves_nothing(tmp_path, capsys, monkeypatch) -> None:
    path = tmp_path / "method.toml"

    def opened(self, *words, **more):
        self.touch()
        return FullFile()

    monkeypatch.setattr(Path, "open", opened)
    assert main(["settings", "--write", str(path), "--json"]) == 2
    error = json.loads(capsys.readouterr().err)["error"]
    assert ("No space left on device" in error["what"], error["where"]) == (True, str(path))
    assert list(tmp_path.iterdir()) == [], "the next try would be refused"


class FullFile(io.BytesIO):
    """File on a disk without room."""

    def flush(self):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_run_follows_the_file_and_records_it(tmp_path, capsys) -> None:
    path = tmp_path / "method.toml"
    path.write_text("[policy]\nmax_probes = 1\n", "utf-8")
    runs = tmp_path / "runs"
    words = ["stack", "--seed", "7", "--method", str(path), "--runs", str(runs), "--no-episodes"]
    assert main([*words, "--json"]) == 1
    (trial,) = json.loads(capsys.readouterr().out)["trials"]
    assert (trial["outcome"], trial["probes"]) == ("gave_up", 1)
    head = (next(runs.glob("*")) / EVENT_LOG_NAME).read_text("utf-8").splitlines()[1]
    method = json.loads(json.loads(head)["settings"])["method"]
    assert method["policy"]["max_probes"] == 1
    assert method["stability"]["delta"] == 0.9


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[policy]\nmax_probs = 1\n", "policy.max_probs"),
        ("[stability]\ndelta = 1.5\n", "stability.delta"),
        ("[policy]\nmax_probes = \n", "TOML"),
        ('strategy = "paper"\n', "strategy"),
    ],
)
def test_a_bad_file_is_one_error_and_leaves_nothing(text, said, tmp_path, capsys) -> None:
    path = tmp_path / "method.toml"
    path.write_text(text, "utf-8")
    runs = tmp_path / "runs"
    assert main(["stack", "--method", str(path), "--runs", str(runs), "--json"]) == 2
    error = json.loads(capsys.readouterr().err)["error"]
    assert error["where"] == str(path)
    assert said in error["what"] + error["fix"]
    assert not runs.exists()


ENDS = [
    TrialFinished(1.0, 1, 7, Outcome.PLACED, "stands", 3, 0, 1.25),
    TrialFinished(1.0, 1, 8, Outcome.FELL, "fell", 2, None, -0.5),
]


def shown(pieces: tuple[str, ...]) -> list[list[str]]:
    stream = io.StringIO()
    VerbOutput(json=False, stream=stream).show(trial_table(ENDS, pieces))
    rows = [line for line in stream.getvalue().splitlines() if line[:1] in "┃│"]
    return [
        [cell.strip() for cell in row.strip("┃│ ").replace("│", "┃").split("┃")] for row in rows
    ]


def test_rows_are_led_by_their_piece_where_there_are_several() -> None:
    assert [row[0] for row in shown(())] == ["seed", "7", "8"]
    assert shown(("pot", "barrel")) == [
        ["piece", "seed", "outcome", "probes", "excess", "margin mm", "reason"],
        ["pot", "7", "placed", "3", "0", "+1.25", "stands"],
        ["barrel", "8", "fell", "2", "", "-0.50", "fell"],
    ]


def test_reasons_of_a_table_name_commands_instead_of_steps_in_the_window() -> None:
    end = TrialFinished(1.0, 1, 7, Outcome.ABORTED, "Then press Reset.", 0, None, None)
    for lab, reason in (
        ("", "Then start again."),
        ("b.toml", "run 'touchdown bench b.toml --reset'"),
    ):
        (cell,) = list(trial_table([end], lab=lab).columns[-1].cells)
        assert reason in str(cell)


HANDS = {
    "sound": lambda fx, fy, fz: (fx, fy, fz),
    "swapped axes": lambda fx, fy, fz: (fz, fy, fx),
    "four times the counts": lambda fx, fy, fz: (4 * fx, 4 * fy, 4 * fz),
}


@pytest.mark.promise("S11")
@pytest.mark.parametrize("hand", HANDS)
def test_a_bench_is_not_ready_with_a_wrist_sensor_that_does_not_weigh_its_hand(
    hand, tmp_path, capsys, monkeypatch
):
    hangs = add_noise(lambda now_s: (*HANDS[hand](0.3, -0.2, -14.7), 0.0, 0.0, 0.0))
    wrist = TcpServer(EmulatedDynpick(hangs))
    wrist.start()
    lab = tmp_path / "lab.toml"
    lab.write_text('version = 1\nname = "b"\nkind = "hardware"\nmounting.payload_kg = 1.4\n')
    ft = {"driver": "dynpick", "address": wrist.url}
    sensor = make_force_torque(HardwareSettings.model_validate({"ft": ft}), time.monotonic)
    connection = BenchConnection({"force_torque": sensor})
    session = SimpleNamespace(connection=connection, close=sensor.close, raw=None, clock_s=None)
    monkeypatch.setattr(bench, "lab_session", lambda choice, keep: closing(session))
    timing = rig.SensorTiming("force_torque", 3, *(5 * (float("nan"),)))
    monkeypatch.setattr(rig, "measure_timing", lambda *_: [timing])
    ready = hand == "sound"
    assert main(["bench", str(lab), "--connect", "--json"]) == (0 if ready else 1)
    wrist.close()
    told = json.loads(capsys.readouterr().out)
    (line,) = told["devices"]
    assert line["state"] == ("ready" if ready else "failed")
    figures = [(one["name"], one["samples"], one["rate_hz"]) for one in told["timing"]]
    assert figures == ([("force_torque", 3, None)] if ready else [])
    assert ("mounting.payload_kg = 1.4 weighs 13.7 N" in line["text"]) != ready


@pytest.mark.parametrize(
    ("words", "content", "what"),
    [
        ("settings --method {file}", "kind = 'hardware'", "a lab file"),
        ("settings --method {file}", "preset = 'quiet'", "a file of a simulated bench"),
        ("stack --method {file}", "[gelsight]", "a lab file"),
        ("stack --bench {file}", "[stability]", "a file with settings of the method"),
    ],
)
def test_a_settings_file_of_another_kind_is_named(words, content, what, tmp_path, capsys) -> None:
    file = tmp_path / "file.toml"
    file.write_text(content, "utf-8")
    assert main([*words.format(file=file).split(), "--json"]) == 2
    error = json.loads(capsys.readouterr().err)["error"]
    assert (error["what"], error["where"]) == (f"This is {what}.", str(file))


def test_a_method_file_with_an_unknown_setting_is_one_error(tmp_path, capsys) -> None:
    method = tmp_path / "old.toml"
    method.write_text("[contours]\nrisk = 0.05\n", "utf-8")
    assert main(["settings", "--method", str(method)]) == 2
    assert "There is no setting 'contours'." in capsys.readouterr().err


def test_an_unknown_network_is_an_error_that_lists_the_names(tmp_path, capsys) -> None:
    method = tmp_path / "method.toml"
    method.write_text('[fused]\nweights = "anny"\n', "utf-8")
    assert main(["stack", "--strategy", "fused", "--method", str(method), "--json"]) == 2
    error = json.loads(capsys.readouterr().err)["error"]
    assert error["where"] == str(method)
    for part in ("'fused.weights'", "'anny'", "'any'", "'wrench'", ".safetensors"):
        assert part in error["what"]
