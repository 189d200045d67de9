"""Keys of a workspace with two halves: each acts in the half that is in front."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from app.keys import portable
from app.workspace import Command


def by_half(
    front: Callable[[], str], titles: Mapping[str, str], commands: Mapping[str, Sequence[Command]]
) -> tuple[Command, ...]:
    """Return all commands; a key that several halves use becomes one row that names them all.

    ``front`` tells the half in front; ``titles`` and ``commands`` by name of the half. A command of
    a half behind does nothing.
    """
    rows: dict[str, Command] = {}
    acts: dict[str, dict[str, Callable[[], None]]] = {}
    for half, given in commands.items():
        for command in given:
            key = portable(command.key) or f"{half}.{command.name}"
            text = f"{titles[half]}: {command.text}"
            known = rows.get(key)
            if known is None:
                rows[key] = replace(command, text=text, run=_runner(front, acts, key))
            else:
                both = f"{known.text}; {text}"
                rows[key] = replace(known, text=both, repeats=known.repeats and command.repeats)
            acts.setdefault(key, {})[half] = command.run
    return tuple(rows.values())


def _runner(
    front: Callable[[], str], acts: Mapping[str, Mapping[str, Callable[[], None]]], key: str
) -> Callable[[], None]:
    def run() -> None:
        act = acts[key].get(front())
        if act is not None:
            act()

    return run
