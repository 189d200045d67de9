"""The fusion network over several probes."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.learning.fused import (
        certificate,
        checkpoint,
        features,
        guard,
        inference,
        training,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
