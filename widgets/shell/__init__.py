"""Parts of the window: top bar, cards, palette, tour."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.widgets.shell import devices, fault_cards, keys, state, top_bar, tour

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
