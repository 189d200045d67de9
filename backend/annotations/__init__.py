"""Labels of a dataset: index, revisions, undo, review, queues, recovery."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.annotations import (
        agreement,
        backups,
        consistency,
        control_items,
        database,
        dataset,
        episode_files,
        episode_index,
        geometry_records,
        labels,
        operation_log,
        queues,
        rebuild,
        reconciliation,
        review,
        run_tracking,
        storage,
        training_set,
        undo,
        values,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
