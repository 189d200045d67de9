"""The form of a run as it is remembered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace

from backend.runs.requests import SceneChoice
from widgets.run_panel import RunForm


def form_of(memory: Mapping[str, object]) -> tuple[RunForm, list[str]]:
    """Return (form, names of what made no sense); those fields get their defaults."""
    default, known, dropped = RunForm(), {}, []
    for entry in fields(RunForm):
        value = memory.get(entry.name, getattr(default, entry.name))
        if type(value) is type(getattr(default, entry.name)):
            known[entry.name] = value
        else:
            dropped.append(entry.name)
    return RunForm(**known), dropped  # type: ignore[arg-type]


def careful(form: RunForm, on_bench: SceneChoice) -> RunForm:
    """Return the form for devices: asked before each move, and nothing let go untested.

    It begins with what is ``on_bench``, whatever was filled in for another one.
    """
    mode = "approve" if form.mode == "auto" else form.mode
    strategy = "paper" if form.strategy == "pick-and-place" else form.strategy
    *under, bottom = on_bench.bottoms
    stands = replace(form, piece=on_bench.piece, bottom=bottom, under="".join(under[:1]))
    return replace(stands, mode=mode, strategy=strategy)
