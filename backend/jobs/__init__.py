"""Jobs named by a hash of their parameters, and the executors that run them."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.jobs import cluster, execution, job, sources

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
