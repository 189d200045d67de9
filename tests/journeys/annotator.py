"""The window in a process of its own with people at its keyboard, forked by ``tests.warm``.

It is the application as it is started by its user; a timer in it presses keys on its window, looks
at what is shown, and says on standard output what the window called saved. Its words on the
command line are the parts of the day to play. Whoever started it may kill it at any moment.
"""

from __future__ import annotations

import json
import os
import pkgutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterator
from importlib import import_module
from itertools import count
from typing import Any

from PySide6.QtCore import QObject, Qt, QTimer
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

import touchdown.app
import touchdown.widgets
from touchdown.app import start
from touchdown.app.application import TouchdownApp
from touchdown.app.label.text import QUEUES as LISTED
from touchdown.backend.core import data_folder

# What the window and its bench import as they go, in the process from which they are forked.
for package in (touchdown.app, touchdown.widgets):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        import_module(module.name)
for name in ("mujoco", "scipy.stats", "touchdown.backend.bench.assembly"):
    import_module(name)

KEY = Qt.Key
NONE = Qt.KeyboardModifier.NoModifier
CTRL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier
ALT = Qt.KeyboardModifier.AltModifier
TURN_MS = 3
PATIENCE_S = 240.0
QUEUES = {name: row for row, (name, _) in enumerate(LISTED)}  # rows of the list that Ctrl+J opens
WAYS = 7  # number of ways to decide, taken in turn by the place among all episodes
REVIEWER_REJECTS = 8  # Bob rejects every eighth label

Condition = Callable[[], object]
Doing = Generator[Condition, None, None]


def tell(**what: object) -> None:
    """Say something to whoever started this."""
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


class Person:
    """Hands on the keyboard and eyes on the window."""

    def __init__(self, main: TouchdownApp) -> None:
        self.main = main
        self.workspace = main.workspaces["collect"].label  # type: ignore[attr-defined]
        self.page = self.workspace.label_page

    def press(self, key: Qt.Key, modifiers: Qt.KeyboardModifier = NONE) -> None:
        """Press one key where the keyboard is: in an open list, else in the window."""
        popup = QApplication.activePopupWidget()
        window = popup.window().windowHandle() if popup else self.main.window.windowHandle()
        QTest.keyClick(window, key, modifiers)

    def type(self, text: str) -> None:
        for letter in text:
            self.press(KEY(ord(letter.upper())))

    @property
    def uuid(self) -> str:
        return self.presenter.present.item.entry.uuid

    @property
    def presenter(self):
        return self.workspace.presenter

    def calm(self) -> bool:
        """True if the window has done all that was asked, and shows it as saved."""
        p = self.presenter
        return (
            p is not None
            and p.walk.begun
            and not (p.saving.busy or p.editing.waits or self.page.choice.isVisible())
            and self.page.strip.saved != "unsaved"
        )

    def do(self, *keys: Qt.Key | tuple[Qt.Key, Qt.KeyboardModifier]) -> Doing:
        """Press keys one after the other, each after the one before has had its effect."""
        for key in keys:
            self.press(*key) if isinstance(key, tuple) else self.press(key)
            yield self.calm

    def be(self, name: str) -> Doing:
        self.press(KEY.Key_U, CTRL)
        yield self.page.words.isVisible
        self.type(name)  # over the former name, which is marked
        yield from self.do(KEY.Key_Return)
        assert self.page.person.text() == name

    def choose(self, queue: str) -> Doing:
        self.press(KEY.Key_J, CTRL)
        yield QApplication.activePopupWidget
        self.press(KEY.Key_Home)
        for _ in range(QUEUES[queue]):
            self.press(KEY.Key_Down)
        yield from self.do(KEY.Key_Return)
        assert self.page.queue.currentData() == queue

    def go_to_front(self) -> Doing:
        """Begin with the first of the queue: an episode that is in both stays in front."""
        yield from self.do(*[KEY.Key_PageUp] * self.presenter.walk.at)

    def acknowledged(self, uuid: str) -> None:
        """Tell what the window says of an episode that was dealt with."""
        head = self.presenter.book.head(uuid)
        rows = self.page.list.rows()
        # At the end of a queue it is read again, and nothing is left.
        assert not rows or [row.state for row in rows if row.uuid == uuid] == [head.state]
        tell(
            saved=uuid, rev=head.rev_uuid, state=head.state, x_um=head.label.x_um,
            y_um=head.label.y_um, person=head.person, reason=head.reason, source=head.source,
        )  # fmt: skip


def arrive(me: Person) -> Doing:
    """Come to the label page as somebody who starts for the first time, or after a crash."""
    window = me.main.window
    yield window.isActiveWindow
    first = me.page.person.text() == "nobody"
    if first:
        me.press(KEY.Key_2, CTRL)
        me.press(KEY.Key_F2)
        yield me.page.words.isVisible
        me.type("ann")
        me.press(KEY.Key_Return)
    yield lambda: me.calm() and me.presenter.present is not None
    assert me.page.isVisible()
    tell(
        begun=list(me.presenter.walk.order), person=me.page.person.text(), first=first,
        at=me.uuid, undo=bool(me.presenter.book._stack("ann").undo),
    )  # fmt: skip


def take_back(me: Person) -> Doing:
    """Undo what was done last before the crash, and do it again: it is the same."""
    order = me.presenter.walk.order

    def content() -> list[tuple[object, ...]]:
        book, found = me.presenter.book, []
        for entry in me.presenter.dataset.episodes():
            head = book.head(entry.uuid)
            found.append((head.label, head.state, head.source, head.reason, book.marks(entry.uuid)))
        return found

    before = content()
    yield from me.do(KEY.Key_U)
    assert content() != before
    yield from me.do((KEY.Key_U, SHIFT))
    assert content() == before
    yield from me.do((KEY.Key_R, CTRL))
    assert me.presenter.walk.order == order


def label(me: Person) -> Doing:
    """Label the queue from the present episode to its end, in all ways that the keys offer."""
    left = len(me.presenter.walk.order) - me.presenter.walk.at
    places = sorted(entry.uuid for entry in me.presenter.dataset.episodes())
    for _ in range(left):
        uuid = me.uuid
        # Left over by a crash: decided in the way it would have been, not in another.
        way = places.index(uuid) % WAYS
        tell(at=uuid, way=way)
        yield from decide(me, way)
        me.acknowledged(uuid)
    assert "end of the queue" in me.page.message.text()
    tell(end="label")


def decide(me: Person, way: int) -> Doing:
    """Come to a decision about the episode in front."""
    uuid = me.uuid
    if way == 1:
        me.press(KEY.Key_Right)
        yield me.calm
        me.acknowledged(uuid)
    elif way == 2:
        me.type("1.5,-2.25")
        me.press(KEY.Key_Return)
        yield me.calm
        me.acknowledged(uuid)
    elif way == 3:
        me.press(KEY.Key_D)
        yield me.page.choice.isVisible
        yield from me.do(KEY.Key_2)
        return
    elif way == 4:
        yield from me.do(KEY.Key_Return, KEY.Key_U)
        assert me.uuid == uuid
        me.acknowledged(uuid)
    elif way == 5:
        assert me.presenter.present.item.model is not None
        yield from me.do(KEY.Key_M)
        me.acknowledged(uuid)
    elif way == 6:
        yield from me.do(KEY.Key_X)
        me.press(KEY.Key_Up, ALT)
        me.press(KEY.Key_Down, SHIFT)
        yield me.calm
    yield from me.do(KEY.Key_Return)


def nudge_and_die(me: Person) -> Doing:
    """Nudge the episode in front, and end without warning 0.6 s later."""
    uuid = me.uuid
    x_um = me.presenter.present.edit.label.x_um or 0
    me.press(KEY.Key_Right)
    QTimer.singleShot(600, lambda: os.kill(os.getpid(), signal.SIGKILL))
    tell(nudged=uuid, x_um=x_um + 100)
    yield lambda: False


def look(me: Person, uuid: str) -> Doing:
    """Go to an episode by its number in the queue, and tell what is shown of it."""
    at = me.presenter.walk.order.index(uuid)
    if me.uuid != uuid:
        me.press(KEY.Key_Q)
        yield me.page.words.isVisible
        me.type(str(at + 1))
        yield from me.do(KEY.Key_Return)
        yield lambda: me.calm() and me.uuid == uuid
    strip, row = me.page.strip, me.page.list.rows()[at]
    history = me.page.side.history.list
    tell(
        saw=uuid, at=at, when=row.detail, row=[row.title, row.state, *row.badges],
        strip=[strip.state, *strip.badges, strip.saved.partition(", ")[2]],
        basis=me.page.basis.text(), message=me.page.message.text(),
        versions=[history.item(k).text().splitlines()[0] for k in range(history.count())],
    )  # fmt: skip


def chosen() -> list[str]:
    return os.environ["CHOSEN"].split(",")


def nudge_chosen(me: Person) -> Doing:
    for uuid in chosen():
        yield from look(me, uuid)
        me.press(KEY.Key_Right)
        yield me.calm
        yield from look(me, uuid)


def take_back_chosen(me: Person) -> Doing:
    for uuid in chosen():
        yield from look(me, uuid)
    for uuid in reversed(chosen()):
        yield from me.do(KEY.Key_U)
        assert me.uuid == uuid, "undo went to another episode"
        yield from look(me, uuid)


def do_chosen_again(me: Person) -> Doing:
    for uuid in chosen():
        yield from me.do((KEY.Key_U, SHIFT))
        assert me.uuid == uuid, "redo went to another episode"
        yield from look(me, uuid)
    for uuid in chosen():
        yield from look(me, uuid)
        yield from me.do(KEY.Key_Return)


def four_eyes(me: Person) -> Doing:
    """Ann tries to approve her own label, in an audit that draws one of hers."""
    dataset, sitting = me.presenter.dataset, me.workspace.session

    def is_own(uuid: str) -> bool:
        return me.presenter.book.head(uuid).state == "submitted"

    sitting.seed = next(
        n for n in count() if any(map(is_own, dataset.queue("audit", "ann", seed=n)))
    )
    yield from me.choose("audit")
    yield from me.go_to_front()
    order = me.presenter.walk.order
    yield from me.do(*[KEY.Key_PageDown] * order.index(next(filter(is_own, order))))
    uuid = me.uuid
    yield from me.do(KEY.Key_Return)
    assert is_own(uuid)
    tell(refused=me.page.message.text(), uuid=uuid)
    sitting.seed = 0


def review(me: Person) -> Doing:
    """Bob approves what waits for him, and rejects some."""
    yield from me.be("bob")
    yield from me.choose("review")
    yield from me.go_to_front()
    order = list(me.presenter.walk.order)
    tell(waiting=order)
    for number, uuid in enumerate(order):
        assert me.uuid == uuid
        if number % REVIEWER_REJECTS == 0:
            me.press(KEY.Key_D)
            yield me.page.choice.isVisible
            yield from me.do(KEY.Key_1)
        else:
            yield from me.do(KEY.Key_Return)
        me.acknowledged(uuid)
    tell(end="review")


def correct(me: Person) -> Doing:
    """Ann corrects what Bob rejected, and Bob approves that."""
    yield from me.be("ann")
    yield from me.choose("returned")
    yield from me.go_to_front()
    order = []
    for uuid in list(me.presenter.walk.order):
        assert me.uuid == uuid
        if me.presenter.book.head(uuid).person == "ann":
            # She rejected that herself, and leaves it.
            yield from me.do(KEY.Key_PageDown)
            continue
        order.append(uuid)
        me.press(KEY.Key_Left, SHIFT)
        yield me.calm
        yield from me.do(KEY.Key_Return)
        me.acknowledged(uuid)
    yield from me.be("bob")
    yield from me.choose("review")
    assert me.presenter.walk.order == order
    yield from me.go_to_front()
    for uuid in order:
        yield from me.do(KEY.Key_Return)
        me.acknowledged(uuid)
    tell(end="correct", corrected=order)


def train(me: Person) -> Doing:
    """Bob trains on what was approved, with the form as it stands but for the epochs."""
    workspace: Any = me.main.workspaces["train"]
    me.press(KEY.Key_3, CTRL)
    form = workspace.page.form

    def settled() -> bool:
        return workspace.presenter is not None and not workspace._worker.busy

    yield settled
    epochs = form.epochs
    epochs.setFocus()
    epochs.selectAll()
    me.type("2")
    me.press(KEY.Key_Tab)
    yield lambda: settled() and form.start.isEnabled()
    me.press(KEY.Key_Return, CTRL)
    yield lambda: workspace.presenter.thread is not None
    yield lambda: workspace.presenter.thread is None and settled()
    tell(end="train", runs=workspace.page.runs.texts())


PARTS = {
    "arrive": arrive, "take-back": take_back, "label": label, "four-eyes": four_eyes,
    "review": review, "correct": correct, "train": train, "nudge-and-die": nudge_and_die,
    "nudge": nudge_chosen, "take-back-chosen": take_back_chosen, "do-again": do_chosen_again,
}  # fmt: skip


class Day(QObject):
    """Plays parts of the day on the window's own thread, whenever nothing else is to do."""

    def __init__(self, main: TouchdownApp, parts: list[str]) -> None:
        super().__init__(main)
        self._main, self._doing = main, self._play(Person(main), parts)
        self._until: Condition = lambda: True
        self._since_s = time.monotonic()
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._turn)
        self._timer.start(TURN_MS)

    def _play(self, me: Person, parts: list[str]) -> Iterator[Condition]:
        for part in parts:
            yield from PARTS[part](me)
        tell(cards=list(me.main.cards.codes))
        me.press(KEY.Key_Q, CTRL)

    def _turn(self) -> None:
        try:
            if self._until():
                self._until = next(self._doing)
                self._since_s = time.monotonic()
            elif time.monotonic() - self._since_s > PATIENCE_S:
                raise TimeoutError(f"it never came to that: {self._main.window.front}")
        except StopIteration:
            self._timer.stop()
        except Exception:  # noqa: BLE001 - whoever waits for words must hear of any end
            self._timer.stop()
            self._main.window.grab().save(str(data_folder() / "annotator-failed.png"))
            tell(failed=traceback.format_exc())
            self._main.quit_at_once(1)


class Held(TouchdownApp):
    """The application, which begins its day once its window is shown."""

    def start(self) -> None:
        super().start()
        self.window.activateWindow()
        self.day = Day(self, sys.argv[1:])


def main() -> int:
    start.TouchdownApp = Held  # type: ignore[misc]
    from touchdown.app.__main__ import main as run

    return run([])
