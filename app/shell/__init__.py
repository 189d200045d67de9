"""Parts of the application that the workspaces share."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.app.shell import (
        actions,
        activity,
        bench_text,
        cards,
        datasets,
        errors,
        label_items,
        layouts,
        live,
        run_story,
        saving,
        settings,
        sheets,
        top_bar,
        window,
        workspace,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
