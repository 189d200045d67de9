"""Plots of signals, maps and distributions."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.widgets.plots import axes, distribution, force_traces, recorded_traces, training

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
