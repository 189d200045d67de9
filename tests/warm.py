"""Child processes that start in milliseconds: forked from one that has imported their module.

The main function of the module runs as ever, in a process of its own, with its own arguments,
environment, pipes and exit status. Only the seconds of importing torch or Qt are saved.
"""

import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import IO, Any

LONGEST_BYTES = 1 << 16
ROOT = Path(__file__).resolve().parents[1]


class WarmStart:
    """Stands in for ``subprocess.Popen``; the server is started when it is first needed."""

    def __init__(self, module: str) -> None:
        self._module = module
        self._server: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None

    @property
    def pid(self) -> int | None:
        """Of the server, None before it is needed."""
        return None if self._server is None else self._server.pid

    def popen(self, command: Sequence[str], **options: Any) -> Any:
        if list(command[1:3]) != ["-m", self._module]:
            return subprocess.Popen(command, **options)
        start = json.dumps([list(command[2:]), dict(options["env"])])
        return WarmChild(self.connected(), start.encode(), options["stderr"])

    def close(self) -> None:
        if self._server is not None and self._control is not None:
            self._control.close()
            self._server.wait(60)

    def connected(self) -> socket.socket:
        if self._control is None:
            self._control, far = socket.socketpair()
            with far:
                self._server = subprocess.Popen(
                    [sys.executable, "-m", "tests.warm", self._module],
                    stdin=far,
                    stdout=subprocess.DEVNULL,
                    cwd=ROOT,
                )
        return self._control


class WarmChild:
    """The part of ``subprocess.Popen`` that is used of these children."""

    def __init__(self, control: socket.socket, start: bytes, stderr: IO[Any]) -> None:
        their_in, our_in = os.pipe()
        our_out, their_out = os.pipe()
        self._status, told = os.pipe()
        theirs = [their_in, their_out, stderr.fileno(), told]
        socket.send_fds(control, [start], theirs)
        for descriptor in (their_in, their_out, told):
            os.close(descriptor)
        self.pid = int(control.recv(LONGEST_BYTES))
        self.stdin = os.fdopen(our_in, "w", encoding="utf-8")
        self.stdout = os.fdopen(our_out, encoding="utf-8")
        self.returncode: int | None = None

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status as ``Popen`` does, minus the number of the signal if killed."""
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("warm", timeout or 0.0)
            self.returncode = int(os.read(self._status, 64) or b"-9")
            os.close(self._status)
        return self.returncode

    def kill(self) -> None:
        if self.returncode is None:
            with suppress(ProcessLookupError):  # it has ended, and the server has seen it
                os.kill(self.pid, signal.SIGKILL)


def serve(control: socket.socket, module: str) -> None:
    """Fork a child for each message; tell its pid, and its status when it has ended."""
    main = import_module(module).main  # before there is anything to fork
    gc.collect()
    gc.freeze()
    ended, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    waiting: dict[int, int] = {}
    while True:
        ready = select.select([control, ended], [], [])[0]
        if ended in ready:
            os.read(ended, LONGEST_BYTES)
            _reap(waiting)
        if control in ready:
            message, received, _, _ = socket.recv_fds(control, LONGEST_BYTES, 4)
            if not message:
                return
            pid = os.fork()
            if not pid:
                for descriptor in (control.fileno(), ended, wake, *waiting.values()):
                    os.close(descriptor)
                _run(main, *json.loads(message), received)
            waiting[pid] = received.pop()
            for descriptor in received:
                os.close(descriptor)
            control.send(str(pid).encode())


def _reap(waiting: dict[int, int]) -> None:
    for pid in list(waiting):
        gone, status = os.waitpid(pid, os.WNOHANG)
        if gone:
            told = waiting.pop(pid)
            os.write(told, str(os.waitstatus_to_exitcode(status)).encode())
            os.close(told)


def _run(
    main: Callable[[], int], words: list[str], environment: dict[str, str], received: list[int]
) -> None:
    """Be the child; never returns."""
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.environ.clear()
        os.environ.update(environment)
        sys.argv = words
        for number, descriptor in enumerate(received[:3]):
            os.dup2(descriptor, number)
        for descriptor in received:
            os.close(descriptor)
        sys.stdin = os.fdopen(0, encoding="utf-8", closefd=False)
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", closefd=False)
        code = main()
        sys.stdout.flush()
    except BaseException:  # noqa: BLE001 - said as an interpreter says it
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


if __name__ == "__main__":
    serve(socket.socket(fileno=0), sys.argv[1])
