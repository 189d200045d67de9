"""What an operator can get wrong is one clear error before any work or window."""

import pytest

from touchdown.backend.cli.command_line import VERBS, main
from touchdown.backend.cli.doctor.command import check_catalogue


@pytest.mark.parametrize("words", [["--theme", "foo"], ["--them", "x"], ["--size", "big"]])
def test_bad_words_for_the_window_are_bad_input(words, capsys) -> None:
    assert main(["app", *words]) == 2
    assert "See 'touchdown app --help'." in capsys.readouterr().err


def test_the_help_of_the_window_is_shown(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["app", "--help"])
    assert "--reset-layout" in capsys.readouterr().out


def test_a_model_that_cannot_be_written_is_refused_first(tmp_path, capsys) -> None:
    (tmp_path / "file").write_text("")
    assert main(["train", str(tmp_path / "none"), "--out", str(tmp_path / "file" / "m")]) == 2
    said = capsys.readouterr()
    assert "cannot be written" in said.err
    assert "Training" not in said.out


def test_doctor_names_a_broken_piece_file(tmp_path) -> None:
    assert check_catalogue().ok
    (tmp_path / "mine.toml").write_text("title = 3\n")
    check = check_catalogue(tmp_path)
    assert not check.ok
    assert "mine.toml" in check.detail


def test_the_help_parts_every_verb_from_its_line(capsys) -> None:
    assert main([]) == 2
    said = capsys.readouterr().out
    for name, text in VERBS.items():
        assert f"  {name} " in said
        assert f" {text}\n" in said


def test_settings_that_are_no_text_name_no_line(tmp_path, capsys) -> None:
    (tmp_path / "bench.toml").write_bytes(b"\x00\xff\xfe")
    assert main(["stack", "--bench", str(tmp_path / "bench.toml")]) == 2
    said = capsys.readouterr().err
    assert "not text" in said
    assert "line" not in said


def test_garbage_is_no_journal(tmp_path, capsys) -> None:
    (tmp_path / "journal.jsonl").write_text("garbage\n")
    assert main(["replay", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "not a Touchdown event log" in said
    assert "before it" not in said


def test_a_bottom_that_does_not_exist_is_called_a_bottom(capsys, tmp_path) -> None:
    assert main(["stack", "--bottom", "nowhere", "--runs", str(tmp_path)]) == 2
    assert "no bottom piece 'nowhere'" in capsys.readouterr().err


def test_nothing_is_said_before_bad_words_are_refused(capsys, tmp_path) -> None:
    words = ["--dataset", str(tmp_path / "d"), "--runs", str(tmp_path / "r"), "--count", "0"]
    assert main(["collect", *words]) == 2
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "words", [["--bottom", "short"], ["--bottom", "short+long", "--below", "1", "0", "0"]]
)
def test_an_entry_below_needs_a_tower_and_an_uncertainty(words, capsys) -> None:
    entry = [] if "--below" in words else ["--below", "1", "0", "0.5"]
    assert main(["stack", *words, *entry]) == 2
    assert "--below" in capsys.readouterr().err
