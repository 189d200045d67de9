"""What an operator can get wrong is one clear error before any work or window."""

import pytest

from backend.__main__ import main
from backend.verbs.check_machine import check_catalogue


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
