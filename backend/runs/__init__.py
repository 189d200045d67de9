"""Requests, plans, the engine that runs them, and the event log."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.runs import (
        bench,
        calibrate,
        calibrations,
        campaign,
        collector,
        engine,
        event_log,
        manual_control,
        messages,
        motions,
        outcome,
        plan,
        plans,
        recorder,
        requests,
        stack,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
