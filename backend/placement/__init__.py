"""Belief, stability, policy and strategies of placement."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.placement import (
        belief,
        equilibrium,
        estimator,
        label_review,
        policy,
        strategies,
        support_tower,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
