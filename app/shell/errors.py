"""Handling of uncaught errors."""

from __future__ import annotations

import logging
import math
import sys
import threading
import traceback
from collections import OrderedDict, deque
from collections.abc import Callable
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path
from types import TracebackType

from PySide6.QtCore import QMessageLogContext, QtMsgType, qInstallMessageHandler

from touchdown.backend.core import check_writable
from touchdown.widgets.base import tr
from touchdown.widgets.shell import CardText

log = logging.getLogger("touchdown")  # of the window and of the devices
BOX_SIZE = 64
# Interval between log lines of a repeated text, so that it cannot fill the disk.
REPEAT_INTERVAL_S = 5.0
REMEMBERED_TEXTS = 64


class RepeatFilter(logging.Filter):
    """Passes each text once in ``AGAIN_S``, then with the number of repetitions.

    Records with the attribute ``raised`` are compared by it instead of their text, which may
    contain varying numbers.
    """

    def __init__(self) -> None:
        super().__init__()
        self._seen: OrderedDict[str, tuple[float, int]] = OrderedDict()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if ``record`` is written."""
        text = record.getMessage()
        same = getattr(record, "raised", text)
        since_s, count = self._seen.pop(same, (-math.inf, 0))
        if record.created - since_s < REPEAT_INTERVAL_S:
            self._seen[same] = (since_s, count + 1)
            return False
        self._seen[same] = (record.created, 0)
        while len(self._seen) > REMEMBERED_TEXTS:
            self._seen.popitem(last=False)
        if count:
            record.msg, record.args = f"{text}\n({count} times more in between)", None
        return True


class ErrorBox:
    """Collects errors from any thread; the pump reads them on the GUI thread."""

    def __init__(self) -> None:
        self._cards: deque[CardText] = deque(maxlen=BOX_SIZE)

    def take(self) -> CardText | None:
        """Return and remove the oldest error, None without one."""
        try:
            return self._cards.popleft()
        except IndexError:
            return None

    def exception(
        self,
        kind: type[BaseException],
        error: BaseException | None,
        trace: TracebackType | None,
        where: str,
    ) -> None:
        """Record an uncaught exception."""
        details = "".join(traceback.format_exception(kind, error, trace))
        raised = f"{kind.__name__} {traceback.extract_tb(trace)[-1:]}"
        log.error("uncaught in %s\n%s", where, details, extra={"raised": raised})
        self._cards.append(
            CardText(
                code=f"BUG-{kind.__name__.upper()}",
                what=tr("An unexpected error occurred in {}: {}", where, error or kind.__name__),
                consequence="The program goes on; this part may be incomplete.",
                next_step="Copy the details into a report.",
                details=details,
                reset=False,
            )
        )

    def message(self, kind: QtMsgType, context: QMessageLogContext, text: str) -> None:
        """Record a message of Qt; warnings and worse become cards."""
        if kind in (QtMsgType.QtDebugMsg, QtMsgType.QtInfoMsg):
            log.info("Qt: %s", text)
            return
        log.warning("Qt: %s", text)
        if "This plugin does not support" in text:
            return
        details = f"{text}\n{context.file}:{context.line}" if context.file else text
        self._cards.append(
            CardText("QT", tr("The window system reports: {}", text),
                     "The picture may be incomplete.", "Copy the details into a report.", details,
                     reset=False)
        )  # fmt: skip


def install_error_hooks(box: ErrorBox) -> Callable[[], None]:
    """Route all error hooks to ``box``; return the function that restores the former ones."""
    before = (sys.excepthook, threading.excepthook, sys.unraisablehook)

    def on_exception(
        kind: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        if issubclass(kind, KeyboardInterrupt):
            before[0](kind, error, trace)
            return
        box.exception(kind, error, trace, "the window")

    def on_thread(args: threading.ExceptHookArgs) -> None:
        name = args.thread.name if args.thread is not None else "a thread"
        box.exception(args.exc_type, args.exc_value, args.exc_traceback, f"thread '{name}'")

    def on_unraisable(args: sys.UnraisableHookArgs) -> None:
        box.exception(args.exc_type, args.exc_value, args.exc_traceback, "a clean-up")

    sys.excepthook = on_exception
    threading.excepthook = on_thread
    sys.unraisablehook = on_unraisable
    qt_before = qInstallMessageHandler(box.message)

    def restore() -> None:
        sys.excepthook, threading.excepthook, sys.unraisablehook = before
        qInstallMessageHandler(qt_before)

    return restore


# Control characters are written as numbers.
_SHOWN = {
    code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\t\n"
}


class _FileFormatter(logging.Formatter):
    """Writes times in UTC with the offset, so that logs of two time zones can be merged."""

    def format(self, record: logging.LogRecord) -> str:
        return super().format(record).translate(_SHOWN)

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:
        return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")


def log_to(folder: Path) -> Path | None:
    """Write the log to a rotating file in ``folder``; return None if it is not writable."""
    path = folder / "app.log"
    try:
        check_writable(folder)
        handler = RotatingFileHandler(path, maxBytes=1_000_000, backupCount=3, encoding="utf-8")
    except OSError as error:
        log.warning("no log file: %s", error)
        return None
    handler.addFilter(RepeatFilter())
    handler.setFormatter(_FileFormatter("%(asctime)s %(levelname)s %(message)s"))
    logging.raiseExceptions = False  # lines are lost on a full disk, without tracebacks
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    return path
