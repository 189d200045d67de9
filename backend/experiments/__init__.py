"""The tables of the paper, and studies that go beyond them."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from touchdown.backend.experiments import (
        certification,
        collection,
        comparison,
        document,
        domain_shift,
        evaluation,
        fusion,
        identification_report,
        job_kinds,
        models,
        results,
        run_report,
        sensitivity,
        statistics,
        strategies,
        tables,
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
