"""The bench is built on a thread of its own; the window stays alive meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable

from app.link import Link
from backend.core.faults import TouchdownError
from widgets.fault_cards import CardText


class Arrival:
    """At most one bench on its way. ``take`` is called by the pump."""

    def __init__(self) -> None:
        self._arrived: list[Link | Exception] = []
        self._make: Callable[[], Link] | None = None
        self.waiting = False

    def begin(self, make: Callable[[], Link]) -> None:
        """Build the bench; does nothing while one is on its way."""
        if self.waiting:
            return
        self.waiting, self._make = True, make
        threading.Thread(target=self._build, args=(make,), name="connect", daemon=True).start()

    def again(self) -> bool:
        """Try once more what failed; False if nothing was ever begun."""
        if self._make is None:
            return False
        self.begin(self._make)
        return True

    def take(self) -> Link | Exception | None:
        """Return what arrived, or None."""
        if not self._arrived:
            return None
        self.waiting = False
        return self._arrived.pop()

    def _build(self, make: Callable[[], Link]) -> None:
        arrived: Link | Exception = RuntimeError("an error that nobody expected")
        try:
            arrived = make()
        except (TouchdownError, OSError, ValueError, ImportError, RuntimeError) as error:
            arrived = error
        finally:
            # Whatever happened, the window stops saying "connecting".
            self._arrived.append(arrived)


def failed_card(error: Exception, again: Callable[[], None]) -> CardText:
    """Return the card of a bench that could not be prepared; ``again`` tries once more."""
    return CardText(
        "CONNECT",
        f"The bench could not be prepared: {error}",
        "Nothing is connected; recorded runs can still be reviewed.",
        "Try again (Ctrl+L), or run 'touchdown doctor' for the cause.",
        reset=False,
        offer=("Try again", again),
    )
