"""An operator's day under an X server of its own, by keys and a mouse that come from outside.

The window tells where its controls are; what came of the day is read in its files.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time

import pytest

from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.core import Outcome, ProbeCollected, TrialFinished
from touchdown.backend.learning.training_runs import list_training_runs
from touchdown.backend.runs.event_log import read_events

WIDTH, HEIGHT = 1600, 940
REST = (1100, 470)  # a place without a control on the page of jogging
PROBES = 5
# Fewer pictures cost less. The frame after the last tick comes within 80 ms, jitter included.
BENCH = """preset = "mixed"
cycle_us = 20000
[tactile]
rate_hz = 16
drop_share = 0.0
"""
LIMIT_S = 600.0  # nothing takes so long, but on a machine with much else to do
TOUR_STOPS = 10
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1500),
    pytest.mark.skipif(
        not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="needs Xvfb and xdotool"
    ),
]


@pytest.fixture
def display():
    """An X server nobody else uses."""
    read_end, write_end = os.pipe()
    words = ["-displayfd", f"{write_end}", "-screen", "0", f"{WIDTH}x{HEIGHT}x24"]
    server = subprocess.Popen(
        ["Xvfb", *words, "-nolisten", "tcp"], pass_fds=(write_end,), stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(write_end)
    with os.fdopen(read_end) as told:
        number = told.readline().strip()
    yield f":{number}"
    server.terminate()
    server.wait(20.0)


class Operator:
    """Hands at keyboard and mouse, eyes on the window."""

    def __init__(self, display, home):
        self.data, self.said, self._never = home / "data", home / "said.txt", threading.Event()
        self._env = {
            **os.environ, "DISPLAY": display, "QT_QPA_PLATFORM": "xcb", "HOME": str(home),
            "XDG_CONFIG_HOME": str(home / "config"), "TOUCHDOWN_DATA": str(self.data),
        }  # fmt: skip
        bench = home / "brisk.toml"
        bench.write_text(BENCH, "utf-8")
        words = ["--size", f"{WIDTH}x{HEIGHT}", "--bench", bench]
        with self.said.open("w") as said:
            self.window = subprocess.Popen(
                [sys.executable, "-m", "tests.journeys.told_window", *words],
                env=self._env,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=said,
                text=True,
            )

    def close(self):
        self.window.kill()
        self.window.communicate()

    # -- hands ------------------------------------------------------------------------------------

    def do(self, *words):
        command = ["xdotool", *map(str, words)]
        done = subprocess.run(command, env=self._env, check=False, capture_output=True, text=True)
        return done.stdout

    def press(self, *keys):
        self.do("key", *keys)

    def click(self, name):
        self.do("mousemove", *self.control(name)["at"], "click", 1)

    def fill(self, name, text):
        def filled():
            self.click(name)
            self.do("key", "ctrl+a", "type", text)
            self.press("Tab")
            return self.control(name)["words"] == text

        self.until(filled)

    def hold(self, name, seconds):
        self.do("mousemove", *self.control(name)["at"], "mousedown", 1)
        self._never.wait(seconds)
        self.do("mouseup", 1, "mousemove", *REST)

    # -- eyes -------------------------------------------------------------------------------------

    def ask(self, word):
        self.window.stdin.write(f"{word}\n")
        self.window.stdin.flush()
        return json.loads(self.window.stdout.readline())

    def control(self, name):
        """Return a control by its name, or by what it says, once it can be used and stands still.

        A page that is just being laid out would move away below the pointer.
        """
        seen, before = [], None

        def usable():
            nonlocal seen, before
            before = seen
            seen = [c for c in self.ask("look") if c["usable"]]
            # The label beside a field says its name too.
            seen = [c for c in seen if c["name"] == name] or [
                c for c in seen if not c["name"] and c["words"] == name
            ]
            return seen and before and seen[0]["at"] == before[0]["at"]

        self.until(usable, every_s=0.1)
        return seen[0]

    def reads(self, words):
        """True if these words stand in the window."""
        return any(words in c["words"] for c in self.ask("look"))

    def reads_like(self, pattern):
        """True if words of this form stand in the window."""
        return any(re.fullmatch(pattern, c["words"]) for c in self.ask("look"))

    def height_mm(self):
        (pose,) = (c["words"] for c in self.ask("look") if re.match("X .* Z ", c["words"]))
        return float(re.search("Z ([0-9.]+)", pose).group(1))

    def log(self):
        file = self.data / "log" / "app.log"
        return file.read_text("utf-8") if file.is_file() else ""

    def facts(self):
        """Return what the newest run told."""
        return list(read_events(max((self.data / "runs").iterdir())))

    def until(self, seen, every_s=0.2):
        end = time.monotonic() + LIMIT_S
        while not seen():
            assert self.window.poll() is None, self.said.read_text()
            assert time.monotonic() < end, f"it did not come: {self.log()}"
            self._never.wait(every_s)


@pytest.fixture
def operator(display, tmp_path):
    made = Operator(display, tmp_path)
    yield made
    made.close()


def test_an_operators_day_by_real_keys_and_mouse(operator):
    arrive(operator)
    jog_and_probe(operator)
    collect(operator)
    with Dataset.open(operator.data / "dataset", create=False, write=False) as dataset:
        label(operator, dataset)
    train(operator)
    stack(operator)
    review(operator)
    stop_and_quit(operator)
    assert operator.said.read_text() == ""
    assert not re.search("WARNING (fault|paused) ", operator.log())


def arrive(operator):
    operator.until(lambda: operator.do("search", "--name", "SIMULATED"))
    # There is no window manager that would give it the focus.
    operator.do("search", "--name", "SIMULATED", "windowfocus", "--sync")
    operator.until(lambda: operator.reads("End the tour"))
    operator.press(*["Return"] * TOUR_STOPS)
    operator.until(lambda: not operator.reads("End the tour"))


def jog_and_probe(operator):
    operator.press("ctrl+1")
    operator.control("Jog +Z")
    before_mm = operator.height_mm()

    def lifted():
        operator.hold("Jog +Z", 0.6)
        return operator.height_mm() > before_mm

    # A window that is late ends the lease: on a busy machine it takes more than one press.
    operator.until(lifted)
    operator.until(lambda: "jog 1 ended" in operator.log())
    operator.ask("hurry")
    operator.press("F5")
    operator.until(lambda: "finished The probe is done." in operator.log())


def collect(operator):
    operator.press("ctrl+2")
    operator.fill("Person", "Ann")
    operator.fill("Probes", str(PROBES))
    operator.click("Ask after every probe")
    operator.click("Start collecting")
    operator.until(lambda: operator.reads(f"{PROBES} of {PROBES}"), every_s=1.0)
    operator.until(lambda: operator.log().count(" finished ") == 2)
    # A probe that is no observation is kept with its reasons and pressed again.
    probes = [f for f in operator.facts() if isinstance(f, ProbeCollected) and not f.reasons]
    assert len(probes) == PROBES


def label(operator, dataset):
    def labelled():
        """True if every observation is labelled; a refused probe may be, too."""
        observed = [entry.uuid for entry in dataset.episodes() if entry.quality.accepted]
        heads = [dataset.labels.head(uuid) for uuid in observed]
        return all((head.state, head.person) == ("submitted", "Ann") for head in heads)

    def accepted():
        # Enter accepts and goes on to the next; while one is being read it does nothing.
        if operator.reads("No displacement yet:"):
            operator.press("Next")
        operator.press("Return")
        return labelled()

    operator.press("F2")
    operator.until(accepted)


def train(operator):
    operator.press("ctrl+3")
    operator.click("Labels")
    operator.press("Down", "Return")
    for name, text in (("Layers", "1"), ("Units", "8"), ("Epochs", "1")):
        operator.fill(name, text)
    operator.click("Start training")
    operator.until(
        lambda: [run.state for run in list_training_runs(operator.data / "dataset")] == ["finished"]
    )


def stack(operator):
    operator.press("ctrl+4")
    operator.click("Start stacking")
    operator.until(lambda: operator.log().count(" finished ") == 3)


def review(operator):
    done = [fact.outcome for fact in operator.facts() if isinstance(fact, TrialFinished)]
    rate = f"{done.count(Outcome.PLACED)} of {len(done)} placed"
    operator.press("ctrl+5")
    # As long as runs are looked for a click on the list chooses none.
    operator.until(lambda: operator.click("Recorded runs") or operator.reads(rate))
    # Nothing plays before the films of the trial are read.
    operator.until(lambda: operator.reads_like("[0-9]+ probes"))
    operator.press("space")
    operator.until(lambda: operator.reads("Pause"))


def stop_and_quit(operator):
    operator.ask("real")
    operator.press("ctrl+4", "ctrl+Return")
    operator.until(lambda: operator.log().count(": stack, pot on short") == 2)
    operator.press("F12")
    operator.until(lambda: "stopped by operator" in operator.log())
    assert operator.log().count("STOP by the operator") == 1
    # A piece is held: the window asks, and its safe answer has the focus.
    operator.press("ctrl+q")
    operator.press("space", "ctrl+q", "Tab", "space")
    assert operator.window.wait(LIMIT_S) == 0
    assert len(list((operator.data / "runs").iterdir())) == 4
