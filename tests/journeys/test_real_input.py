"""The window under an X server of its own, by keys and a mouse that come from outside."""

import json
import os
import shutil
import subprocess
import sys
import threading
import time

import pytest

WIDTH, HEIGHT = 1600, 940
UP_PAD, REST = (1533, 228), (700, 600)
"""Pixels of the pad that moves up on the Operate page, and of a place without a control."""
LIMIT_S = 150.0
TOUR_STOPS = 10
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(
        not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="needs Xvfb and xdotool"
    ),
]


@pytest.fixture
def display():
    """An X server nobody else uses."""
    read_end, write_end = os.pipe()
    words = [
        "-displayfd",
        str(write_end),
        "-screen",
        "0",
        f"{WIDTH}x{HEIGHT}x24",
        "-nolisten",
        "tcp",
    ]
    server = subprocess.Popen(
        ["Xvfb", *words], pass_fds=(write_end,), stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(write_end)
    with os.fdopen(read_end) as told:
        number = told.readline().strip()
    yield f":{number}"
    server.terminate()
    server.wait(20.0)


class Operator:
    """Hands at keyboard and mouse; what the window made of it is read in its files."""

    def __init__(self, display, home):
        self.data, self.said, self._never = home / "data", home / "said.txt", threading.Event()
        self._env = {
            **os.environ, "DISPLAY": display, "QT_QPA_PLATFORM": "xcb", "HOME": str(home),
            "XDG_CONFIG_HOME": str(home / "config"), "TOUCHDOWN_DATA": str(self.data),
        }  # fmt: skip
        self._settings = home / "config" / "touchdown" / "window.json"
        with self.said.open("w") as said:
            self.window = subprocess.Popen(
                [sys.executable, "-m", "app", "--size", f"{WIDTH}x{HEIGHT}"],
                env=self._env,
                stdout=said,
                stderr=said,
            )

    def close(self):
        self.window.kill()
        self.window.wait(20.0)

    def do(self, *words):
        return subprocess.run(
            ["xdotool", *map(str, words)],
            env=self._env,
            check=False,
            capture_output=True,
            text=True,
        ).stdout

    def press(self, *keys):
        for key in keys:
            self.do("key", key)

    def hold(self, place, seconds):
        self.do("mousemove", *place, "mousedown", 1)
        self._never.wait(seconds)
        self.do("mouseup", 1, "mousemove", *REST)

    def log(self):
        file = self.data / "log" / "app.log"
        return file.read_text("utf-8") if file.is_file() else ""

    def settings(self):
        return json.loads(self._settings.read_text("utf-8")) if self._settings.is_file() else {}

    def until(self, seen):
        end = time.monotonic() + LIMIT_S
        while not seen():
            assert self.window.poll() is None, self.said.read_text()
            assert time.monotonic() < end, f"it did not come: {self.log()}"
            self._never.wait(0.2)


@pytest.fixture
def operator(display, tmp_path):
    made = Operator(display, tmp_path)
    yield made
    made.close()


def test_tour_jog_probe_stack_stop_and_quit_by_real_keys_and_mouse(operator):
    operator.until(lambda: operator.do("search", "--name", "SIMULATED"))
    # There is no window manager that would give it the focus.
    operator.do("search", "--name", "SIMULATED", "windowfocus", "--sync")
    operator.until(lambda: operator.settings().get("toured"))
    operator.press(*["Return"] * TOUR_STOPS)
    operator.until(lambda: operator.settings()["front"] == "review")

    operator.press("ctrl+1")
    operator.hold(UP_PAD, 0.6)
    operator.until(lambda: "jog 1 ended" in operator.log())
    operator.press("F5")
    operator.until(lambda: "finished The probe is done." in operator.log())

    operator.press("ctrl+4", "ctrl+Return")
    operator.until(lambda: ": stack, pot on short" in operator.log())
    operator.press("F12")
    operator.until(lambda: "stopped by operator" in operator.log())
    assert operator.log().count("STOP by the operator") == 1

    # A piece is held: the window asks, and its safe answer has the focus.
    operator.press("ctrl+q")
    operator.press("space", "ctrl+q", "Tab", "space")
    assert operator.window.wait(LIMIT_S) == 0
    assert operator.said.read_text() == ""
    assert len(list((operator.data / "runs").iterdir())) == 2
