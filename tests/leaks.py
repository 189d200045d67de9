"""What a test may leave behind: nothing. Cheap snapshots; costly work only where they differ."""

import gc
import os
import socket
import stat
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

GRACE_S = 30.0
"""A thread or child that is just ending gets this long."""

HELPERS = ("resource_tracker", "forkserver")
"""Processes that multiprocessing keeps for the life of the interpreter."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What is alive at one instant; widgets by identity."""

    threads: frozenset[threading.Thread]
    children: frozenset[int]
    sockets: frozenset[int]
    widgets: frozenset[int]


def snapshot(keeper: int | None = None) -> Snapshot:
    """Look at this process; ``keeper`` is a child that stays and whose children count as ours."""
    return Snapshot(
        frozenset(_threads()),
        frozenset(child.pid for child in _children(keeper)),
        frozenset(_sockets()),
        frozenset(id(widget) for widget in _widgets()),
    )


def leaks_since(before: Snapshot, keeper: int | None = None) -> list[str]:
    """Return a sentence for each thing that lives now and did not at ``before``."""
    if snapshot_is_within(before, keeper):
        return []
    for thread in _threads():
        if thread not in before.threads:
            thread.join(GRACE_S)
    psutil.wait_procs(
        [child for child in _children(keeper) if child.pid not in before.children], timeout=GRACE_S
    )
    _delete_deferred()
    gc.collect()
    _delete_deferred()
    found = [f"thread {t.name!r}" for t in _threads() if t not in before.threads]
    found += [
        f"child process {child.pid} ({' '.join(child.cmdline())[:80]})"
        for child in _children(keeper)
        if child.pid not in before.children
    ]
    new = [_address(fd) for inode, fd in _sockets().items() if inode not in before.sockets]
    found += [f"socket {address}" for address in new if address]
    found += [
        f"top-level widget {widget!r}" for widget in _widgets() if id(widget) not in before.widgets
    ]
    return found


def snapshot_is_within(before: Snapshot, keeper: int | None = None) -> bool:
    now = snapshot(keeper)
    return (
        now.threads <= before.threads
        and now.children <= before.children
        and now.sockets <= before.sockets
        and now.widgets <= before.widgets
    )


def _threads() -> list[threading.Thread]:
    # Threads that Qt or C++ started show up as dummies; they are not ours to join.
    return [t for t in threading.enumerate() if not isinstance(t, threading._DummyThread)]


def _children(keeper: int | None) -> list[psutil.Process]:
    if _childless():
        return []
    numbers = _child_numbers(os.getpid())
    if keeper in numbers:
        numbers = (numbers - {keeper}) | _child_numbers(keeper)
    found = []
    for number in sorted(numbers):
        try:
            child = psutil.Process(number)
            # Everything still running counts, and so does what nobody waited for.
            if not any(word in " ".join(child.cmdline()) for word in HELPERS):
                found.append(child)
        except psutil.ZombieProcess:
            found.append(child)
        except psutil.NoSuchProcess:
            continue
    return found


def _child_numbers(parent: int) -> set[int]:
    """Return the ids of the children; Linux keeps a list, elsewhere every process is looked at."""
    lists = [path / "children" for path in Path(f"/proc/{parent}/task").glob("*")]
    if lists and lists[0].exists():
        return {int(word) for path in lists for word in _read(path).split()}
    return {child.pid for child in psutil.Process(parent).children()}


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (FileNotFoundError, ProcessLookupError):
        # The thread whose list this is has ended.
        return ""


def _childless() -> bool:
    """Ask the system at no cost; psutil looks at every process of the machine."""
    if not hasattr(os, "waitid"):
        return False
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return True
    return False


def _sockets() -> dict[int, int]:
    """Return inode and descriptor of each socket; psutil reads all connections of the machine."""
    found = {}
    for path in Path("/dev/fd").glob("*"):
        with suppress(OSError):  # the descriptor of the listing itself
            status = os.fstat(int(path.name))
            if stat.S_ISSOCK(status.st_mode):
                found[status.st_ino] = int(path.name)
    return found


def _address(descriptor: int) -> str:
    """Return the address of an internet socket, nothing for one within this machine."""
    with socket.socket(fileno=os.dup(descriptor)) as end:
        inet = end.family in (socket.AF_INET, socket.AF_INET6)
        return str(end.getsockname()) if inet else ""


def _widgets() -> list[object]:
    module = sys.modules.get("PySide6.QtWidgets")
    if module is None or module.QApplication.instance() is None:
        return []
    return [widget for widget in module.QApplication.topLevelWidgets() if widget.parent() is None]


def _delete_deferred() -> None:
    core = sys.modules.get("PySide6.QtCore")
    if core is None or core.QCoreApplication.instance() is None:
        return
    core.QCoreApplication.sendPostedEvents(None, core.QEvent.Type.DeferredDelete)
    core.QCoreApplication.processEvents()
