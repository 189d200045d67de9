"""What each key of the label half does: rows of the key sheet, in the order of the work."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.label.decisions import Decisions
from app.label.health import HealthPresenter
from app.label.side_keys import SideKeys
from app.label.whole import WholeDataset
from app.workspace import Command, Desk

if TYPE_CHECKING:
    from app.label.workspace import LabelWorkspace

STEPS_UM = (("", 100), ("Shift+", 1000), ("Alt+", 10))
ARROWS = (("Left", -1, 0), ("Right", 1, 0), ("Up", 0, 1), ("Down", 0, -1))


def commands_of(w: LabelWorkspace, desk: Desk) -> tuple[Command, ...]:
    """Return all commands of the label half."""
    return (
        *_decisions(w),
        *_nudges(w),
        *_looks(w),
        *_queue(w),
        *_beside(w),
        *_sitting_and_dataset(w),
        Command("discard", "Discard what could not be saved", "Esc", w.discard),
        Command("sheet", "Key sheet", "?", desk.keys),
    )


def _decisions(w: LabelWorkspace) -> tuple[Command, ...]:
    decide = w.decide
    return (
        Command("accept", "Accept (approve, while reviewing) and next", "Return",
                lambda: decide(Decisions.enter)),
        Command("reject", "Reject, then 1 to 9 for the reason", "D",
                lambda: decide(Decisions.reject)),
        Command("flag", "Flag, or take the flag off", "X", lambda: decide(Decisions.flag)),
        Command("undo", "Undo my last action", "Ctrl+Z", lambda: decide(Decisions.undo)),
        Command("redo", "Redo", "Ctrl+Shift+Z", lambda: decide(Decisions.redo)),
        Command("undo-plain", "Undo my last action", "U", lambda: decide(Decisions.undo)),
        Command("redo-plain", "Redo", "Shift+U", lambda: decide(Decisions.redo)),
        Command("model", "Take the model's displacement", "M",
                lambda: w.on(lambda p: p.editing.take_model())),
        Command("sigma", "Say how sure you are of what you set", "S",
                lambda: w.on(lambda p: p.editing.say_sigma())),
        Command("verdict", "Your verdict, then S, U or ?", "V",
                lambda: decide(Decisions.verdict)),
        Command("take-over", "Take over another's draft", "T",
                lambda: decide(Decisions.take_over)),
        Command("resolve", "Resolve a conflict", "C", lambda: decide(Decisions.resolve)),
        Command("delete", "Delete the episode, with a reason", "Delete",
                lambda: decide(Decisions.delete)),
    )  # fmt: skip


def _nudges(w: LabelWorkspace) -> tuple[Command, ...]:
    def nudge(name: str, prefix: str, dx_um: int, dy_um: int) -> Command:
        step_um = max(abs(dx_um), abs(dy_um))
        return Command(
            f"nudge-{name.lower()}-{step_um}",
            f"Move the face {step_um / 1000:g} mm {name.lower()}",
            f"{prefix}{name}",
            lambda: w.on(lambda p: p.editing.nudge(dx_um, dy_um)),
            repeats=True,
            beside=True,
        )

    return tuple(
        nudge(name, prefix, dx * step_um, dy * step_um)
        for prefix, step_um in STEPS_UM
        for name, dx, dy in ARROWS
    )


def _looks(w: LabelWorkspace) -> tuple[Command, ...]:
    return (
        Command("play", "Play the film from the cursor, or pause (Space)", "",
                lambda: w.label_page.film.play_or_pause()),
        Command("frame-back", "One frame back", "[", lambda: w.label_page.film.step(-1),
                repeats=True, beside=True),
        Command("frame-on", "One frame forward", "]", lambda: w.label_page.film.step(1),
                repeats=True, beside=True),
        Command("pictures", "Pictures: the tactile film, or the scene camera", "I",
                lambda: w.label_page.next_pictures(), beside=True),
        Command("curves", "Choose the curves on one axis", "W",
                lambda: w.label_page.list_curves()),
        Command("hide", "Hide or show the model and other sources", "H", w.hide),
    )  # fmt: skip


def _queue(w: LabelWorkspace) -> tuple[Command, ...]:
    return (
        Command("previous", "Previous, without a decision", "PgUp",
                lambda: w.on(lambda p: p.move(-1))),
        Command("next", "Next, without a decision: skip", "PgDown",
                lambda: w.on(lambda p: p.move(1))),
        Command("first", "First of the queue", "Home", lambda: w.on(lambda p: p.go_to(0))),
        Command("last", "Last of the queue", "End",
                lambda: w.on(lambda p: p.go_to(len(p.walk.order) - 1))),
        Command("number", "Go to a place of the queue, by its number", "Q", w.ask_number),
        Command("queue", "Choose the queue", "Ctrl+J", w.list_queues),
        Command("reread", "Read the queue anew", "Ctrl+R",
                lambda: w.on(lambda p: p.flushed(p.read_queue))),
    )  # fmt: skip


def _beside(w: LabelWorkspace) -> tuple[Command, ...]:
    return (
        Command("versions", "Restore an earlier version, by its digit", "O",
                lambda: w.beside(SideKeys.versions)),
        Command("agreement", "Figures of agreement", "E", lambda: w.beside(SideKeys.agreement)),
        Command("log", "Search the log of all actions", "L", lambda: w.beside(SideKeys.log)),
        Command("bulk", "Change every label of the queue", "B", lambda: w.beside(SideKeys.many)),
        Command("health", "Look through the dataset for what is out of order", "Ctrl+H",
                w.look_through),
        Command("findings", "Choose a finding, by its digit", "F",
                lambda: w.healthy(HealthPresenter.ask)),
    )  # fmt: skip


def _sitting_and_dataset(w: LabelWorkspace) -> tuple[Command, ...]:
    return (
        Command("blind", "Blind mode: no model, no other sources", "Ctrl+B", w.toggle_blind),
        Command("person", "Change the person", "Ctrl+U", w.ask_person),
        Command("score", "Let the model score the dataset: fills four queues", "Ctrl+M",
                lambda: w.all(WholeDataset.score)),
        Command("models", "Choose the models that pre-label: one, or several together",
                "Shift+M", lambda: w.all(WholeDataset.choose_models)),
        Command("merge", "Merge another copy of this dataset", "Ctrl+Shift+M",
                lambda: w.all(WholeDataset.merge)),
    )  # fmt: skip
