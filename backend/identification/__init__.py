"""Identification of a bench from recordings: parameters, uncertainties, replay gate, bench file."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.identification import estimates, identify, recordings, stages

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
