"""What people see, and what scripts get: exactly one JSON object."""

import io
import json

import numpy as np
import pytest
from rich.table import Table

from touchdown.backend.cli.output import VerbOutput


def _screen(*, as_json):
    stream = io.StringIO()
    return VerbOutput(json=as_json, stream=stream), stream


def test_scripts_get_one_object_and_nothing_else():
    screen, stream = _screen(as_json=True)
    screen.say("words")
    screen.show(Table(title="a table"))
    with screen.progress("Working", 3) as advance:
        advance(1, "one")
        advance(3)
    with screen.status() as show:
        show(Table(title="changing"))
    screen.result({"done": True})
    assert json.loads(stream.getvalue()) == {"done": True}
    assert stream.getvalue().count("\n") == 1


def test_people_get_words_and_no_object():
    screen, stream = _screen(as_json=False)
    screen.say("Estimate [0.5, 1.0] mm")
    screen.result({"done": True})
    assert stream.getvalue() == "Estimate [0.5, 1.0] mm\n"


def test_a_long_sentence_is_not_broken():
    screen, stream = _screen(as_json=False)
    screen.say("word " * 100)
    assert stream.getvalue().count("\n") == 1


def test_a_bar_in_a_pipe_is_its_title():
    screen, stream = _screen(as_json=False)
    with screen.progress("Training", 10) as advance:
        advance(5, "half")
    assert stream.getvalue() == "Training ...\n"


def test_numbers_that_json_lacks_become_null():
    screen, stream = _screen(as_json=True)
    screen.result(
        {
            "nan": float("nan"),
            "deep": [{"inf": float("inf")}, (1, np.float64("nan"))],
            "numpy": [np.float32(0.5), np.int64(3), np.bool_(True)],
        }
    )
    assert json.loads(stream.getvalue()) == {
        "nan": None,
        "deep": [{"inf": None}, [1, None]],
        "numpy": [0.5, 3, True],
    }


def test_a_second_object_is_a_defect():
    screen, _ = _screen(as_json=True)
    screen.result({})
    with pytest.raises(RuntimeError, match="exactly one"):
        screen.result({})


def test_brackets_in_a_table_are_text():
    screen, stream = _screen(as_json=False)
    table = Table("reason")
    table.add_row("arm refused [/busy] [BUSY]")
    screen.show(table)
    assert "arm refused [/busy] [BUSY]" in stream.getvalue()
