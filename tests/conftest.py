"""What holds for every test: no screen, no network, no operator's files, nothing left behind."""

import os

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ["QT_SCALE_FACTOR"] = "1"
os.environ.setdefault("OMP_NUM_THREADS", "1")
# What is compiled is kept, also where the environment forbids it: each of some hundred processes
# that the tests start would compile all sources anew, and each worker rewrite the tests.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import ctypes
import gc
import itertools
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

import tests.isolation.sitecustomize  # noqa: F401 - refuses bare names

if os.environ.get("MEASURE_COVERAGE"):
    from tests import statement_coverage

    statement_coverage.begin()  # before the product is imported

from tests.leaks import leaks_since, snapshot
from tests.warm import WarmStart
from touchdown.backend.learning import training_process
from touchdown.backend.runs import campaign

sys.dont_write_bytecode = False
# Children refuse imports by bare names as well.
_ISOLATION = str(Path(__file__).parent / "isolation")
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (_ISOLATION, os.environ.get("PYTHONPATH"))))
settings.register_profile(
    "suite", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("suite")
LOOPBACK = ("127.", "::1", "localhost")
_numbers = itertools.count()
_warm = WarmStart("touchdown.backend.learning.training_child")
_give_back: Any = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
"""Hands freed memory back to the system where the C library would keep it (glibc)."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--promise", metavar="ID", help="run the tests of a row of faults.md, window.md"
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Start with the journeys, which take longest; apply ``--promise``."""
    items.sort(key=lambda item: "journeys" not in item.path.parts)
    if wanted := config.getoption("--promise"):
        items[:] = [
            item
            for item in items
            if any(wanted in marker.args for marker in item.iter_markers("promise"))
        ]


def pytest_sessionfinish() -> None:
    if os.environ.get("MEASURE_COVERAGE"):
        statement_coverage.write()


class NetworkForbiddenError(RuntimeError):
    """A test tried to reach another machine."""


def _guarded(name: str) -> Any:
    original = getattr(socket.socket, name)

    def call(self: socket.socket, *args: Any) -> Any:
        address = args[-1]
        if self.family in (socket.AF_INET, socket.AF_INET6):
            host = str(address[0]) if isinstance(address, tuple) else str(address)
            if not host.startswith(LOOPBACK):
                raise NetworkForbiddenError(f"tests reach no other machine: {host}")
        return original(self, *args)

    return call


@pytest.fixture(autouse=True, scope="session")
def light_collections() -> None:
    """Keep what was imported out of the garbage collector's sight: each look took 0.13 s."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def freed() -> Iterator[None]:
    """Free what refers to itself: the pictures of a few sessions fill a gigabyte."""
    yield
    gc.collect()
    # What outlives a module are imports and caches: no later look has to go through them again.
    gc.freeze()
    if _give_back is not None:
        _give_back(0)


@pytest.fixture(autouse=True, scope="session")
def no_network() -> Iterator[None]:
    patch = pytest.MonkeyPatch()
    for name in ("connect", "connect_ex", "sendto"):
        patch.setattr(socket.socket, name, _guarded(name))
    yield
    patch.undo()


@pytest.fixture(autouse=True, scope="session")
def warm_trainings() -> Iterator[None]:
    """Start trainings without importing torch for each, where a process can be forked safely."""
    yield
    _warm.close()


@pytest.fixture(autouse=True)
def known_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw 0, 1, 2 ... as the seeds of campaigns that name none."""
    numbers = itertools.count()
    monkeypatch.setattr(campaign, "DICE", SimpleNamespace(randrange=lambda _: next(numbers)))


@pytest.fixture(autouse=True)
def warm_start(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let trainings start warm, but in tests that are marked ``cold_start``."""
    if sys.platform == "linux" and request.node.get_closest_marker("cold_start") is None:
        like = SimpleNamespace(
            Popen=_warm.popen, PIPE=subprocess.PIPE, TimeoutExpired=subprocess.TimeoutExpired
        )
        monkeypatch.setattr(training_process, "subprocess", like)


@pytest.fixture(autouse=True)
def isolated_settings(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """Put settings, data and caches in a folder of the test (made when first written)."""
    folder = tmp_path_factory.getbasetemp() / f"operator-{next(_numbers)}"
    monkeypatch.setenv("TOUCHDOWN_DATA", str(folder / "data"))
    for name in ("CONFIG", "DATA", "CACHE", "STATE"):
        monkeypatch.setenv(f"XDG_{name}_HOME", str(folder / name.lower()))
    return folder


@pytest.fixture(autouse=True)
def no_leaks(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test that leaves a top-level widget, a thread, a child process or a socket."""
    before = snapshot(_warm.pid)
    yield
    if request.node.get_closest_marker("allow_leaks") is None:
        found = leaks_since(before, _warm.pid)
        if found:
            pytest.fail(f"left behind: {'; '.join(found)}", pytrace=False)
