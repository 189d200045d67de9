"""The table of figures: what misses its target is said and decides the exit code."""

import json

import pytest

from tests.bench import run
from tests.bench.registry import Figure, figure
from touchdown.backend.core.faults import InputError


@pytest.fixture(autouse=True)
def empty(monkeypatch):
    monkeypatch.setattr(run, "MODULES", ())
    monkeypatch.setattr("tests.bench.registry.REGISTER", {})
    monkeypatch.setattr(run, "REGISTER", {})


def _register(monkeypatch, **measures):
    for name, measure in measures.items():
        monkeypatch.setitem(run.REGISTER, name, ("group " + name, measure))


def test_all_met_is_0_and_all_are_shown(monkeypatch, capsys):
    _register(
        monkeypatch,
        a=lambda: [Figure("speed [ms]", 0.8214, "ms", "<= 1", True, "one thread")],
        b=lambda: [Figure("placed", "58 of 60", "", "stated", None)],
    )
    assert run.main([]) == 0
    shown = capsys.readouterr().out
    for word in ("speed [ms]", "0.8214 ms", "<= 1 ms", "met", "one thread", "58 of 60", "stated"):
        assert word in shown
    assert "2 figures, 0 missed" in shown


def test_one_missed_is_1(monkeypatch, capsys):
    _register(monkeypatch, a=lambda: [Figure("speed", 3.0, "ms", "<= 1", False)])
    assert run.main([]) == 1
    assert "missed" in capsys.readouterr().out


def test_a_figure_that_cannot_be_measured_is_missed_and_the_rest_goes_on(monkeypatch, capsys):
    def broken():
        raise InputError("No model ships.", "pot.safetensors", "make models")

    _register(monkeypatch, a=broken, b=lambda: [Figure("x", 1.0, "", "1", True)])
    assert run.main(["--json"]) == 1
    first, second = json.loads(capsys.readouterr().out)["figures"]
    assert (first["ok"], first["value"]) == (False, None)
    assert "make models" in first["note"]
    assert second["ok"]


@pytest.mark.parametrize("name", ["group b", "b"])
def test_groups_and_figures_are_chosen_by_name(name, monkeypatch, capsys):
    _register(
        monkeypatch,
        a=lambda: [Figure("first", 1.0, "", "", True)],
        b=lambda: [Figure("second", 1.0, "", "", True)],
    )
    assert run.main([name, "--json"]) == 0
    assert [f["name"] for f in json.loads(capsys.readouterr().out)["figures"]] == ["second"]


def test_two_figures_of_one_name_are_a_defect(monkeypatch):
    monkeypatch.setattr("tests.bench.registry.REGISTER", {})

    def speed():
        return []

    figure("a")(speed)
    with pytest.raises(ValueError, match="speed"):
        figure("b")(speed)
