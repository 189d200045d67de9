"""Images and wrenches to marker fields and episodes."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.sensing import (
        detector,
        episode,
        live,
        picture_files,
        scene_camera,
        slip,
        tracker,
        tracking,
        zeroing,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
