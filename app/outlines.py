"""Outlines of the faces of a run, for drawing."""

from __future__ import annotations

from backend.core.facts import RunStarted
from backend.core.faults import InputError
from backend.core.flow import FloatArray
from backend.objects.catalogue import Catalogue


def outlines(
    catalogue: Catalogue, head: RunStarted | None
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the (k, 2) outlines of the piece's face and of the touched bottom; None: unknown."""
    if head is None:
        return None, None
    return _outline(catalogue, head.piece), _outline(catalogue, head.bottom.split("+")[-1])


def _outline(catalogue: Catalogue, name: str) -> FloatArray | None:
    try:
        return catalogue.piece(name).face.polygon(96)
    except InputError:
        return None
