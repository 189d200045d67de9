"""Touchdown: place a grasped piece by touch.

The public API. Frames: z points up; wrenches are those of the environment on the tool, so that
Fz > 0 while the piece is pressed down. Units stand in the names (``_mm``, ``_n``, ``_s``, ``_px``,
``_rad``). Names are imported when they are first used, so ``import touchdown`` is quick.

Method: Ota, Jha, Jatavallabhula, Kanezaki, Tenenbaum, "Tactile Estimation of Extrinsic Contact
Patch for Stable Placement", ICRA 2024, arXiv:2309.14552.
"""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend import (
        annotations,
        bench,
        config,
        core,
        exchange,
        geometry,
        learning,
        placement,
        runs,
        sensing,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
