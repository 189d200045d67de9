"""Who calls a person, and the command that does it."""

import stat

import pytest

from touchdown.backend.core import (
    CommandNotifier,
    Fault,
    FaultRaised,
    HandOverAwaited,
    InputError,
    Paused,
    RunFinished,
    Said,
    person_call,
)

FAULT = Fault("FT-LINK", "The wrist sensor does not answer.", "The arm stands.", "Look at it.")


def script(tmp_path, body):
    """Return the path of a program."""
    path = tmp_path / "call me.sh"
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_faults_questions_and_the_end_call_a_person_and_nothing_else():
    events = (
        FaultRaised(1.0, FAULT),
        Paused(1.0, FAULT),
        HandOverAwaited(1.0, "pot", True),
        RunFinished(1.0, "id", "failed", "The wrist sensor does not answer."),
        Said(1.0, "Probe 1"),
    )
    calls = [person_call(event) for event in events]
    assert [call and call.reason for call in calls] == [
        "fault",
        "question",
        "question",
        "end",
        None,
    ]
    assert calls[0].title == "Touchdown: fault"
    assert calls[0].text == "FT-LINK: The wrist sensor does not answer. Look at it."
    assert calls[2].text == "The run waits for you: a hand at the jaws."
    assert calls[3].text == "The run ended (failed): The wrist sensor does not answer."


def test_the_command_gets_title_and_text_without_a_shell(tmp_path):
    log = tmp_path / "log"
    path = script(tmp_path, f'printf "%s|%s|%s|%s\\n" "$@" "$TOUCHDOWN_REASON" >> "{log}"')
    notifier = CommandNotifier(f"'{path}' '$(id) *'")
    notifier.take(Said(1.0, "Probe 1"))
    notifier.take(RunFinished(1.0, "id", "finished", ""))
    notifier.close()
    assert log.read_text() == "$(id) *|Touchdown: end|The run ended (finished)|end\n"


def test_a_command_that_fails_is_told_once_and_the_next_call_is_made(tmp_path):
    told = []
    notifier = CommandNotifier(f"'{script(tmp_path, 'exit 3')}'", told.append)
    for _ in range(2):
        notifier.take(FaultRaised(1.0, FAULT))
    notifier.close()
    assert len(told) == 1
    assert "The command of --notify failed" in told[0]
    assert "exit status 3" in told[0]


@pytest.mark.parametrize("command", ["", "'open", "no-such-program-at-all x"])
def test_a_command_that_cannot_be_run_is_refused(command):
    with pytest.raises(InputError, match="--notify"):
        CommandNotifier(command)
