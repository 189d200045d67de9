"""Calibration of a bench: records, fits and limits."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.calibration import applied, cameras, estimators, records, result

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
