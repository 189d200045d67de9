"""Episode files and packs in MCAP."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.episodes import (
        episode_mcap,
        mcap_container,
        messages,
        packs,
        quality,
        training_rows,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
