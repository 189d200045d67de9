"""Verbs called in this process."""

from __future__ import annotations

import json

import pytest

from touchdown.backend.cli.command_line import main


@pytest.fixture
def say(capfd):
    """Return what runs a verb with ``--json``: it returns exit code and answer."""

    def call(*words):
        capfd.readouterr()
        code = main([*map(str, words), "--json"])
        out, err = capfd.readouterr()
        return code, json.loads(out or err)

    return call


@pytest.fixture
def lab(tmp_path, capsys):
    path = tmp_path / "lab.toml"
    assert main(["bench", str(path), "--new"]) == 0
    capsys.readouterr()
    return path
