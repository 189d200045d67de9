"""An error in every frame: the log stays small, and says how often what came."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from touchdown.app.shell.errors import (
    BOX_SIZE,
    REMEMBERED_TEXTS,
    REPEAT_INTERVAL_S,
    ErrorBox,
    RepeatFilter,
    log,
    log_to,
)

FRAME_S, LASTS_S = 0.016, 60.0


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    # A file of a window before would see every record, too, and its filter counts on the record.
    before, log.handlers = log.handlers, []
    log_to(tmp_path)
    yield tmp_path
    written, log.handlers = log.handlers, before
    for handler in written:
        handler.close()


def fail(box: ErrorBox, text: str) -> None:
    try:
        raise RuntimeError(text)
    except RuntimeError:
        box.exception(*sys.exc_info(), "the window")


def wind(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Let the records of the log carry a hand-wound time; return it."""
    now = [1000.0]
    make = logging.getLogRecordFactory()

    def made(*args: object, **kinds: object) -> logging.LogRecord:
        record = make(*args, **kinds)
        record.created = now[0]
        return record

    monkeypatch.setattr(logging, "_logRecordFactory", made)
    return now


@pytest.mark.promise("D12")
def test_the_same_error_in_every_frame_is_counted_and_written_now_and_then(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box, now = ErrorBox(), wind(monkeypatch)
    frames = round(LASTS_S / FRAME_S)
    for _ in range(frames):
        fail(box, "broken paint")
        now[0] += FRAME_S
    now[0] += REPEAT_INTERVAL_S
    fail(box, "broken paint")
    (text,) = [path.read_text() for path in folder.iterdir()]
    written = text.count("ERROR uncaught in the window")
    assert LASTS_S / REPEAT_INTERVAL_S <= written <= LASTS_S / REPEAT_INTERVAL_S + 2
    told = [int(line[1:].split()[0]) for line in text.splitlines() if "times more" in line]
    # None is forgotten: written ones and counted ones are all that came.
    assert written + sum(told) == frames + 1
    cards = 0
    while box.take() is not None:
        cards += 1
    assert cards == BOX_SIZE


@pytest.mark.promise("P6")
def test_an_error_whose_text_changes_is_known_by_where_it_was_raised(folder: Path) -> None:
    box = ErrorBox()
    for number in range(50):
        fail(box, f"thread {number}")
    (text,) = [path.read_text() for path in folder.iterdir()]
    assert text.count("ERROR uncaught in the window") == 1


@pytest.mark.promise("D12")
def test_errors_that_are_never_the_same_fill_no_disk(folder: Path) -> None:
    for number in range(2500):
        log.error("error %d %s", number, "x" * 2000)
    sizes = [path.stat().st_size for path in folder.iterdir()]
    assert sum(sizes) <= 10_000_000
    assert (folder / "app.log").read_text().count("error 2499") == 1
    (repeats,) = [f for h in log.handlers for f in h.filters if isinstance(f, RepeatFilter)]
    assert len(repeats._seen) == REMEMBERED_TEXTS


@pytest.mark.promise("D9")
def test_what_a_terminal_would_obey_is_written_as_its_number(folder: Path) -> None:
    log.error("piece %s", "\x1b[2Jcup\r\x07 \u00e4")
    (text,) = [path.read_text() for path in folder.iterdir()]
    assert text.endswith("piece \\x1b[2Jcup\\x0d\\x07 \u00e4\n")
