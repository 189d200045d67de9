"""The closing table: one row per trial, led by its piece where there are several."""

import io

from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.cli.stack import trial_table
from touchdown.backend.core.events import TrialFinished
from touchdown.backend.core.values import Outcome

ENDS = [
    TrialFinished(1.0, 1, 7, Outcome.PLACED, "stands", 3, 0, 1.25),
    TrialFinished(1.0, 1, 8, Outcome.FELL, "fell", 2, None, -0.5),
]


def shown(pieces: tuple[str, ...]) -> list[list[str]]:
    stream = io.StringIO()
    VerbOutput(json=False, stream=stream).show(trial_table(ENDS, pieces))
    rows = [line for line in stream.getvalue().splitlines() if line[:1] in "┃│"]
    return [
        [cell.strip() for cell in row.strip("┃│ ").replace("│", "┃").split("┃")] for row in rows
    ]


def test_rows_are_led_by_their_piece() -> None:
    assert shown(("pot", "barrel")) == [
        ["piece", "seed", "outcome", "probes", "excess", "margin mm", "reason"],
        ["pot", "7", "placed", "3", "0", "+1.25", "stands"],
        ["barrel", "8", "fell", "2", "", "-0.50", "fell"],
    ]


def test_a_run_of_one_piece_needs_no_such_column() -> None:
    assert [row[0] for row in shown(())] == ["seed", "7", "8"]
