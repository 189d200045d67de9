"""The checks of the harness itself: a check that cannot fail protects nobody."""

import socket
import subprocess
import sys
import threading

import pytest

from tests.conftest import NetworkForbiddenError
from tests.leaks import leaks_since, snapshot


def test_nothing_new_is_no_leak():
    assert leaks_since(snapshot()) == []


def test_a_running_thread_is_named(monkeypatch):
    monkeypatch.setattr("tests.leaks.GRACE_S", 0.01)
    before, end = snapshot(), threading.Event()
    thread = threading.Thread(target=end.wait, name="left-over")
    thread.start()
    assert leaks_since(before) == ["thread 'left-over'"]
    end.set()
    thread.join()
    assert leaks_since(before) == []


def test_a_running_child_is_named(monkeypatch):
    monkeypatch.setattr("tests.leaks.GRACE_S", 0.01)
    before = snapshot()
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    (found,) = leaks_since(before)
    child.communicate(b"\n")
    assert str(child.pid) in found
    assert leaks_since(before) == []


def test_a_child_of_the_keeper_is_named(monkeypatch):
    monkeypatch.setattr("tests.leaks.GRACE_S", 0.01)
    code = "import subprocess, sys; input(); subprocess.run([sys.executable, '-c', 'input()'])"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) as keeper:
        before = snapshot(keeper.pid)
        assert leaks_since(before, keeper.pid) == []
        assert keeper.pid not in before.children
        assert keeper.stdin is not None
        keeper.stdin.write(b"\n")
        keeper.stdin.flush()
        while not (found := leaks_since(before, keeper.pid)):
            pass
        assert "input()" in found[0]
        keeper.communicate(b"\n")


def test_an_open_socket_is_named():
    before = snapshot()
    with socket.create_server(("127.0.0.1", 0)):
        (found,) = leaks_since(before)
    assert "127.0.0.1" in found
    assert leaks_since(before) == []


def test_a_forgotten_window_is_named(qapp):
    from PySide6.QtWidgets import QWidget

    before = snapshot()
    forgotten = QWidget()
    forgotten.setObjectName("forgotten")
    (found,) = leaks_since(before)
    assert "QWidget" in found
    forgotten.close()
    forgotten.deleteLater()
    del forgotten
    assert leaks_since(before) == []


@pytest.mark.parametrize("method", ["connect", "connect_ex"])
def test_no_test_reaches_another_machine(method):
    with socket.socket() as wire, pytest.raises(NetworkForbiddenError):
        getattr(wire, method)(("192.0.2.1", 80))


def test_datagrams_are_refused_too():
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire,
        pytest.raises(NetworkForbiddenError),
    ):
        wire.sendto(b"x", ("192.0.2.1", 80))


def test_this_machine_may_be_reached():
    with socket.create_server(("127.0.0.1", 0)) as server:
        socket.create_connection(server.getsockname()).close()


def test_the_operator_s_folders_are_not_seen(isolated_settings, monkeypatch):
    from touchdown.backend.runs.recorder import data_folder

    assert data_folder() == isolated_settings / "data"
