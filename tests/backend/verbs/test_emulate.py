"""``touchdown emulate``: a device for others to speak to, and what it says of itself."""

import json
import queue
import socket
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from touchdown.backend.cli import emulate
from touchdown.backend.cli.command_line import main
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.config.lab import load_lab
from touchdown.backend.config.toml_file import read_settings
from touchdown.backend.devices.registry import emulated_makes
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.protocol import WsgCommand, WsgRequest


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
    def handed_over(cancel):
        told.put(cancel)
        yield

    monkeypatch.setattr(emulate, "ctrl_c_cancels", handed_over)
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


@pytest.mark.parametrize(
    "words",
    [
        ["wsg", "--tty", "x"],
        ["dynpick", "--tty", "x", "--port", "5000"],
        ["dynpick", "--load", "1,2"],
        ["dynpick", "--port", "0"],
        ["dynpick", "--for", "nan"],
        ["gelsight"],
        ["toaster"],
    ],
)
def test_bad_words_are_bad_input(words, capsys):
    assert main(["emulate", *words]) == 2
    assert "fix:" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [["stack", "--emulated", "--inject", "arm:stall@1"], ["emulate", "bench"]]
)
def test_what_the_emulated_bench_lacks_is_said_before_it_starts(words, capsys):
    assert main(words) == 2
    assert "fix:" in capsys.readouterr().err


def test_a_folder_named_from_here_leads_to_the_bench_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["emulate", "bench", "--folder", "new", "--lab-file", "new/lab.toml", "--for", "0.02"]
    assert main(words) == 0
    lab = load_lab(tmp_path / "new" / "lab.toml")
    assert lab.settings.ft.address == str(tmp_path / "new" / "force_torque")
    assert Path(lab.settings.gelsight.by_id).parent == (tmp_path / "new").resolve()


def test_a_bench_leaves_its_file_in_the_folder(tmp_path, capsys):
    assert main(["emulate", "bench", "--folder", str(tmp_path), "--for", "0.02", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["seen"]["step_share"] == 0.0
    told = result["bench"]
    hardware = read_settings(HardwareSettings, tmp_path / "bench.toml")
    assert hardware.ft.address == told["ft"]["address"]
    assert hardware.wsg.port == told["wsg"]["port"]
