"""Settings of the method, the simulated bench, the hardware and the laboratory."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.config import (
        bench_description,
        hardware,
        lab,
        method,
        simulation,
        toml_file,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
