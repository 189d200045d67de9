"""Forms, buttons and fields."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.widgets.forms import (
        collect_form,
        fields,
        jogging,
        probe,
        questions,
        run_form,
        training_form,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
