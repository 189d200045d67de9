"""Memory shared by two processes: nothing torn, nothing lost in silence, nothing left behind."""

import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.rig.memory import BACKEND_BEAT, PREFIX, attach, drop, make


@pytest.fixture
def both():
    mine, path = make()
    other = attach(path)
    drop(path)
    assert not path.parent.exists()
    return mine, other


def block(first, count, channels=6):
    t_s = 1e-3 * np.arange(first, first + count)
    return t_s, np.arange(first, first + count)[:, None] + np.zeros(channels)


def test_one_side_reads_what_the_other_has_put(both):
    mine, other = both
    mine.wrench.put(*block(0, 5))
    t_s, values, cursor = other.wrench.since(0)
    assert (t_s == block(0, 5)[0]).all()
    assert (values[:, 3] == np.arange(5)).all()
    mine.wrench.put(*block(5, 2))
    assert other.wrench.since(cursor)[1][:, 0].tolist() == [5, 6]
    mine.beat(BACKEND_BEAT)
    mine.permit(1.25)
    assert (other.backend_beats, other.rig_beats, other.lease_until_s) == (1, 0, 1.25)


def test_a_slow_reader_gets_the_newest_and_never_waits(both):
    mine, other = both
    size = mine.wrench.capacity
    for first in range(0, 3 * size, size // 2):
        mine.wrench.put(*block(first, size // 2))
    t_s, values, cursor = other.wrench.since(10)
    assert (len(t_s), cursor) == (size, 3 * size)
    assert values[0, 0] == 2 * size
    # More at once than there is room for: the newest of it.
    mine.wrench.put(*block(0, size + 7))
    assert other.wrench.since(cursor)[1][:, 0].tolist() == list(range(7, size + 7))


def test_no_record_is_read_torn():
    """A writer that never rests: each row read is of one piece."""
    mine, path = make()
    other = attach(path)
    drop(path)
    stop = threading.Event()

    def write():
        first = 0
        while not stop.is_set():
            mine.poses.put(*block(first, 700, 3))
            first += 700

    thread = threading.Thread(target=write)
    thread.start()
    read, cursor = 0, 0
    try:
        for _ in range(20_000):
            t_s, values, cursor = other.poses.since(cursor)
            assert (values == values[:, :1]).all()
            assert np.allclose(t_s, 1e-3 * values[:, 0])
            read += len(t_s)
            if read > 20_000:
                break
            # The writer may have been interrupted within a piece: it has its turn.
            stop.wait(1e-4)
    finally:
        stop.set()
        thread.join()
    assert read > 0


def test_a_state_is_read_whole_or_not_at_all(both):
    mine, other = both
    assert other.seen() is None
    mine.show({"arm": {"state": "ready", "text": "x" * 5000}})
    assert other.seen()["arm"]["state"] == "ready"
    mine.show({"arm": 1})
    assert other.seen() == {"arm": 1}
    with pytest.raises(ValueError, match="too long"):
        mine.show({"arm": "x" * 20_000})
    assert other.seen() == {"arm": 1}


def test_notes_are_kept_in_order_and_cut_where_too_long(both):
    mine, other = both
    for k in range(1030):
        mine.note(0.001 * k, f"note {k}" if k < 1029 else "é" * 400)
    notes = other.notes()
    assert len(notes) == 1024
    assert notes[0] == (pytest.approx(0.006), "note 6")
    assert notes[-1][1] == "é" * 240


@pytest.mark.promise("P11")
def test_what_a_killed_program_left_is_swept_at_the_next_start():
    gone = subprocess.run(
        [sys.executable, "-c", "from touchdown.backend.rig.memory import make; print(make()[1])"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    left = Path(gone.stdout.strip())
    assert left.exists()
    assert left.parent.name.startswith(PREFIX)
    _, path = make()
    drop(path)
    assert not left.exists()
