"""A second simulated bench with other physics, for tests of transfer."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.simulation.second_world import trials

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
