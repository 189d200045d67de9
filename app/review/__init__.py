"""Review workspace: play recordings and read reports."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.app.review import workspace

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
