"""A window whose annotator does to a gold episode what she does to an ordinary one.

``python -m`` this module with the parts to play; the episodes are named in ``CHOSEN``. It says what
anybody who looks at the window could see of each.
"""

from __future__ import annotations

import os
import sys

from tests.journeys import annotator
from tests.journeys.annotator import KEY, SHIFT, Doing, Person, tell


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


def nudge(me: Person) -> Doing:
    for uuid in chosen():
        yield from look(me, uuid)
        me.press(KEY.Key_Right)
        yield me.calm
        yield from look(me, uuid)


def take_back(me: Person) -> Doing:
    for uuid in chosen():
        yield from look(me, uuid)
    for uuid in reversed(chosen()):
        yield from me.do(KEY.Key_U)
        assert me.uuid == uuid, "undo went to another episode"
        yield from look(me, uuid)


def do_again(me: Person) -> Doing:
    for uuid in chosen():
        yield from me.do((KEY.Key_U, SHIFT))
        assert me.uuid == uuid, "redo went to another episode"
        yield from look(me, uuid)
    for uuid in chosen():
        yield from look(me, uuid)
        yield from me.do(KEY.Key_Return)


if __name__ == "__main__":
    annotator.PARTS |= {"nudge": nudge, "take-back": take_back, "do-again": do_again}
    sys.exit(annotator.main())
