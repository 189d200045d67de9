"""Arms that take a stream of set points: pressing, moves and compliance."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.devices.streamed import arm, compliance, motion_programs

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
