"""What importing a package loads, and that the method runs without simulation or window."""

import json
import re
import subprocess
import sys
import tomllib
from email.message import Message
from importlib.metadata import distributions
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

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


def _licence(package: Message) -> str:
    """Return the licence that the metadata of a package state, in one line."""
    if stated := package["License-Expression"] or package["License"]:
        first = str(stated).splitlines()[0]
        if package["License-Expression"] or ("Copyright" not in first and len(first) <= 60):
            return first
    kinds = package.get_all("Classifier", [])
    return ", ".join(k.rpartition(" :: ")[2] for k in kinds if k.startswith("License ::"))


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", re.split(r"[\[<>=!;~ ]", name)[0]).lower()


def test_the_licences_of_all_dependencies_are_listed() -> None:
    page = (ROOT / "docs" / "dependencies.md").read_text("utf-8").rpartition("|---|---|\n")[2]
    listed = dict(re.findall(r"^\| (\S+) \| (.+) \|$", page, re.MULTILINE))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    pinned = [line for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()
              if not line.startswith("#")]  # fmt: skip
    wanted = [
        *project["dependencies"],
        *chain.from_iterable(project["optional-dependencies"].values()),
        *pinned,
    ]
    assert {_plain(name) for name in wanted} == set(listed)
    found = {_plain(d.name): _licence(d.metadata) for d in distributions()}
    assert {n: found[n] for n in listed if n in found} == {
        n: listed[n] for n in listed if n in found
    }
