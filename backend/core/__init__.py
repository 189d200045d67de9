"""Value types, events, faults, streams and clocks that every other package uses."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.core import (
        clock,
        contact_onset,
        event_bus,
        events,
        faults,
        files,
        marker_interpolation,
        notification,
        rotations,
        scheduling,
        stalled_processes,
        streams,
        values,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
