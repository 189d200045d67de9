"""Contact-patch networks: training, checkpoints, registry, evaluation."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.learning import (
        calibration,
        checkpoint,
        fitting,
        inference,
        metrics,
        registry,
        training,
        training_data,
        training_process,
        training_runs,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
