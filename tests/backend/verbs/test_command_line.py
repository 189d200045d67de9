"""The frame of the command line: exit codes, one JSON object, errors that say what to do."""

import importlib
import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from touchdown.backend.cli import command_line
from touchdown.backend.cli.command_line import VERBS, main, module_of
from touchdown.backend.core.faults import (
    Fault,
    FaultError,
    InputError,
    RefusedError,
    StaleSampleError,
)


@pytest.fixture
def verb(monkeypatch):
    """Let the verb `stack` do what the test says."""

    def install(run, add_arguments=lambda parser: None):
        module = SimpleNamespace(NAME="stack", HELP="", run=run, add_arguments=add_arguments)
        monkeypatch.setattr(command_line.importlib, "import_module", lambda name: module)

    return install


def _raise(error):
    def run(args, screen):
        raise error

    return run


@pytest.mark.parametrize("code", [0, 1])
def test_the_verb_s_own_code_is_the_exit_code(verb, code):
    verb(lambda args, screen: code)
    assert main(["stack"]) == code


def test_every_verb_offers_what_the_frame_needs():
    for name in VERBS:
        module = importlib.import_module(module_of(name))
        assert name == module.NAME
        assert module.HELP
        assert callable(module.add_arguments)
        assert callable(module.run)


@pytest.mark.parametrize("name", VERBS)
def test_every_verb_explains_itself(name, capsys):
    with pytest.raises(SystemExit) as left:
        main([name, "--help"])
    assert left.value.code == 0
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--help"], ["--version"]])
def test_help_and_version_are_no_errors(words, capsys):
    with pytest.raises(SystemExit) as left:
        main(words)
    assert left.value.code == 0
    assert "touchdown" in capsys.readouterr().out


def test_without_a_verb_the_verbs_are_listed(capsys):
    assert main([]) == 2
    shown = capsys.readouterr().out
    assert all(name in shown for name in VERBS)


@pytest.mark.parametrize(
    "words", [["stak"], ["stack", "--no-such-thing"], ["stack", "--trials", "many"], ["--wrong"]]
)
def test_bad_words_are_bad_input(words, capsys):
    assert main(words) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert "fix:" in output.err
    assert "Traceback" not in output.err


def test_bad_input_for_scripts_is_one_object_on_standard_error(verb, capsys):
    verb(_raise(InputError("Broken.", "pieces/pot.toml", "Mend it.")))
    assert main(["stack", "--json"]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert json.loads(output.err) == {
        "error": {"what": "Broken.", "where": "pieces/pot.toml", "fix": "Mend it."}
    }


def test_bad_input_for_people_names_all_three(verb, capsys):
    verb(_raise(InputError("Broken.", "pieces/pot.toml", "Mend it.")))
    assert main(["stack"]) == 2
    shown = capsys.readouterr().err
    assert all(word in shown for word in ("Broken.", "pieces/pot.toml", "Mend it."))


FAULT = Fault("CAMERA-STALE", "The left camera stopped.", "The run ended.", "Reconnect it.", "left")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (FaultError(FAULT), ("left camera stopped", "CAMERA-STALE", "Reconnect it.")),
        (RefusedError("unloaded", "The piece still presses."), ("still presses", "unloaded")),
        (StaleSampleError("wrench: no sample yet"), ("wrench: no sample yet",)),
    ],
)
@pytest.mark.parametrize("json_flag", [[], ["--json"]])
def test_a_run_that_failed_says_why(verb, capsys, error, words, json_flag):
    verb(_raise(error))
    assert main(["stack", *json_flag]) == 1
    output = capsys.readouterr()
    assert output.out == ""
    assert all(word in output.err for word in words)
    if json_flag:
        assert set(json.loads(output.err)["error"]) == {"what", "where", "fix"}


def test_an_interrupt_is_130(verb):
    verb(_raise(KeyboardInterrupt()))
    assert main(["stack"]) == 130


def test_a_defect_is_not_hidden(verb):
    verb(_raise(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        main(["stack"])


def test_a_verb_may_hand_unknown_words_on(verb):
    seen = []

    def run(args, screen):
        seen.append(args.handed_on)
        return 0

    verb(run, lambda parser: parser.set_defaults(handed_on=[]))
    assert main(["stack", "--theme", "dark"]) == 0
    assert seen == [["--theme", "dark"]]


def test_doctor_does_not_load_torch_or_qt():
    code = (
        "import sys; import touchdown.backend.cli.command_line, touchdown.backend.cli.doctor.command; "
        "sys.exit(any(name in sys.modules for name in ('torch', 'PySide6', 'cv2')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
