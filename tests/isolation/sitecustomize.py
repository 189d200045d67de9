"""Refuse imports of the product's folders by their bare names, in tests and in their children.

A class imported as ``backend.x`` and as ``touchdown.backend.x`` would exist twice. The folder of
this module is put on ``PYTHONPATH`` by ``tests/conftest.py``, so that each child loads it.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

BARE = frozenset({"app", "backend", "widgets", "resources"})


class RefuseBareNames:
    """Finder that raises for the bare name of a product folder."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Raise ``ImportError`` for a bare name, else leave the search to other finders."""
        if name in BARE:
            raise ImportError(f"Import touchdown.{name}, not {name}.")
        return None


if not any(isinstance(finder, RefuseBareNames) for finder in sys.meta_path):
    sys.meta_path.insert(0, RefuseBareNames())
