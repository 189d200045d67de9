"""What importing a package loads, and that the method runs without simulation or window."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

REFUSE = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.startswith({names!r}):
            raise ImportError("refused: " + name)
sys.meta_path.insert(0, Refuse())
"""
LOADED = "import json; print(json.dumps(sorted(sys.modules)))"


def run(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_bare_names_are_refused_here_and_in_children() -> None:
    with pytest.raises(ImportError, match=r"Import touchdown\.backend"):
        __import__("backend")
    child = "try:\n import widgets\nexcept ImportError as e:\n print(e)"
    assert "Import touchdown.widgets" in run(child)


SIMULATION = ("touchdown.backend.simulation", "touchdown.backend.bench.assembly")
WINDOW = ("PySide6", "shiboken6", "pyqtgraph", "touchdown.app", "touchdown.widgets")
ALL_MODULES = """
import importlib, pathlib, touchdown.backend as backend
root = pathlib.Path(next(iter(backend.__path__)))
for package in ("sensing", "placement", "runs"):
    for path in sorted((root / package).glob("*.py")):
        name = f"touchdown.backend.{package}.{path.stem}".removesuffix(".__init__")
        importlib.import_module(name)
print(len(list((root / "runs").glob("*.py"))))
"""


def test_the_method_loads_without_simulation_and_window() -> None:
    refuse = REFUSE.format(names=(*SIMULATION, *WINDOW))
    assert int(run(refuse + ALL_MODULES)) > 10
    code = refuse + "try:\n import touchdown.backend.simulation\nexcept ImportError as e: print(e)"
    assert "refused" in run(code)


HEAVY = ("torch", "cv2", "PySide6", "pyqtgraph", "scipy.optimize", "mujoco", "pyarrow", "av")
# What a module is allowed to load of the heavy packages.
ALLOWED: dict[str, set[str]] = {
    "touchdown": set(),
    "touchdown.backend.rig.process": set(),
    "touchdown.backend.placement.strategies": {"cv2"},
    "touchdown.backend.learning.inference": set(),
    "touchdown.backend.learning.fused.inference": set(),
}


@pytest.mark.parametrize("module", sorted(ALLOWED))
def test_light_modules_load_nothing_heavy(module: str) -> None:
    loaded = set(json.loads(run(f"import sys; import {module}; {LOADED}")))
    assert loaded & set(HEAVY) <= ALLOWED[module]


def test_children_inherit_the_import_path() -> None:
    """No child computes the path of the package from a file name."""
    code = "import touchdown, sys; print(touchdown.__file__)"
    assert Path(run(code).strip()).samefile(sys.modules["touchdown"].__file__ or "")
