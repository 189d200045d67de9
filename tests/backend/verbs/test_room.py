"""A run on a terminal that a full disk paused: its operator makes room, or lets it end."""

import io
import sys

import pytest

from touchdown.backend.cli.connection import wait_for_disk_space
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core.faults import Fault

FULL = Fault("DISK-FULL", "Only 0.42 GB are free.", "The run is paused.", "Make room.")


@pytest.mark.parametrize(
    ("typed", "json", "waits", "made", "left"),
    [
        ("\nnext", False, True, True, "next"),
        ("", False, True, False, ""),
        ("\nnext", True, True, False, "\nnext"),
        ("\nnext", False, False, False, "\nnext"),
    ],
)
def test_an_enter_goes_on_and_nobody_is_waited_for_in_vain(
    monkeypatch, typed, json, waits, made, left
):
    said = io.StringIO()
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))

    assert wait_for_disk_space(FULL, VerbOutput(json=json, stream=said), "run", waits=waits) is made
    assert sys.stdin.read() == left
    assert ("0.42 GB" in said.getvalue()) is not json
    assert ("press Enter" in said.getvalue()) is (waits and not json)
