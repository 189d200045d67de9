"""Import and export of episodes and labels in foreign formats."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.exchange import (
        coco,
        csv_tables,
        exports,
        imports,
        jsonl,
        label_import,
        manifest,
        query,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
