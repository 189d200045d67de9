"""Leak detection and coverage of the tests, and the references that Qt for Python may lose."""

import json
import socket
import subprocess
import sys
import threading

import pytest
from coverage.parser import PythonParser

from tests import statement_coverage
from tests.conftest import NetworkForbiddenError
from tests.leaks import leaks_since, snapshot


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr("tests.leaks.GRACE_S", 0.01)


def test_a_running_thread_is_named():
    before, end = snapshot(), threading.Event()
    thread = threading.Thread(target=end.wait, name="left-over")
    thread.start()
    assert leaks_since(before) == ["thread 'left-over'"]
    end.set()
    thread.join()
    assert leaks_since(before) == []


def test_a_running_child_is_named():
    before = snapshot()
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    (found,) = leaks_since(before)
    child.communicate(b"\n")
    assert str(child.pid) in found
    assert leaks_since(before) == []


def test_a_child_of_the_keeper_is_named():
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
    with socket.create_server(("127.0.0.1", 0)) as server:
        (found,) = leaks_since(before)
        socket.create_connection(server.getsockname()).close()  # this machine may be reached
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


@pytest.mark.parametrize(("method", "data"), [("connect", ()), ("connect_ex", ()),
                                              ("sendto", (b"x",))])  # fmt: skip
def test_no_test_reaches_another_machine(method, data):
    kind = socket.SOCK_DGRAM if data else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, kind) as wire, pytest.raises(NetworkForbiddenError):
        getattr(wire, method)(*data, ("192.0.2.1", 80))


def test_the_operator_s_folders_are_not_seen(isolated_settings, monkeypatch):
    from touchdown.backend.core import data_folder

    assert data_folder() == isolated_settings / "data"


COUNTS = """
import json, sys
from PySide6.QtCore import QObject, Signal
from PySide6.QtWidgets import QApplication, QWidget

spare = [[value] * 200_000 for value in (True, False, None)]  # a loss reports instead of aborting

class Sender(QObject):
    said = Signal()

def emit():
    sender.said.emit()

def join_and_leave():
    sender.said.connect(emit)
    sender.said.disconnect(emit)

def update():
    widget.update()

app = QApplication([])
sender, widget = Sender(), QWidget()
lost = {}
for name, call in (("emit", emit), ("connect", join_and_leave), ("update", update)):
    call()
    before = [sys.getrefcount(value) for value in (True, False, None)]
    for _ in range(3000):  # tables that grow keep about fifty, however many calls there are
        call()
    after = [sys.getrefcount(value) for value in (True, False, None)]
    lost[name] = max(abs(b - a) for a, b in zip(before, after)) / 3000
json.dump(lost, sys.stdout)
"""


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="these objects are immortal from 3.12 on")
def test_no_reference_to_true_false_none_is_lost():
    done = subprocess.run(
        [sys.executable, "-c", COUNTS], capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    assert max(json.loads(done.stdout).values()) <= 0.3, done.stdout


STATEMENTS = '''"""Every kind of statement."""

from __future__ import annotations

import functools

@functools.cache
@functools.cache
def kind(value: NotYetKnown):
    """Return its kind."""
    match value:
        case int():
            return "int"
        case str() | bytes():
            text = str(
                value
            )
            return text
        case list():
            return "list"
    return "other"

class Number(int):
    size: int = 1

    @property
    def half(self):
        """Half of it."""
        return self / 2

    def twice(self):
        return 2 * self

def tried(action):
    try:
        action()
    except KeyError:
        result = "key"
    except (ValueError,
            TypeError):
        result = "value"
    except OSError:
        result = "system"
    else:
        result = "none"
    finally:
        action = None
    return result

async def never():
    async with other() as one:
        yield one

total = 0
for number in range(3):
    if number > 5:
        total += 5
    elif number > 1: total += 1
    else:
        total -= 1
while total > 9:
    total = 0
else:
    total = 7
kinds = [kind(value) for value in ("a", 1)]
results = [tried(action) for action in (lambda: int("a"), lambda: None)]
half = Number(4).half
with open(__file__) as this:
    pass
'''


def test_marks_tell_the_statements_that_a_trace_function_sees(tmp_path):
    path = tmp_path / "sample.py"
    path.write_text(STATEMENTS)
    parser = PythonParser(text=STATEMENTS)
    parser.parse_source()
    traced = set()

    def trace(frame, event, arg):
        if frame.f_code.co_filename != str(path):
            return None
        if event == "line":
            traced.add(frame.f_lineno)
        return trace

    plain, marked = {"__file__": str(path)}, {"__file__": str(path)}
    before = sys.gettrace()
    sys.settrace(trace)
    try:
        exec(compile(STATEMENTS, path, "exec", dont_inherit=True), plain)
    finally:
        sys.settrace(before)
    marks = [0] * (STATEMENTS.count("\n") + 2)
    marked[statement_coverage.NAME] = marks
    code = compile(statement_coverage.marked(path.read_bytes()), path, "exec", dont_inherit=True)
    exec(code, marked)
    for name in ("total", "kinds", "results", "half"):
        assert marked[name] == plain[name]
    seen = {line for line, mark in enumerate(marks) if mark}
    executed = parser.translate_lines(traced) & parser.statements
    assert parser.translate_lines(seen) == executed
    assert 30 < len(executed) < len(parser.statements)
