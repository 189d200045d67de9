"""Stack workspace: stack a piece and watch the decision."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.app.stack import workspace

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
