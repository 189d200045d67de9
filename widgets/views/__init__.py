"""Views of tactile images, scenes, beliefs and decisions."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.widgets.views import (
        belief,
        decision,
        film,
        offset,
        probe_maps,
        report,
        scene,
        scene_camera,
        scores,
        tactile,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
