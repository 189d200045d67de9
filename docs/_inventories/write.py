"""Write the inventories of other projects, so that ``make docs`` needs no network.

Each holds the names that our pages refer to, with their pages. Add a name below and run
``.venv-docs/bin/python docs/_inventories/write.py``. ``make docs-links`` checks the addresses.
"""

import zlib
from pathlib import Path

HERE = Path(__file__).resolve().parent
PYTHON = {
    "py:class": {
        "pathlib.Path": "library/pathlib.html#$",
        "str": "library/stdtypes.html#$",
        "enum.Enum": "library/enum.html#$",
    },
    "py:exception": {
        "Exception": "library/exceptions.html#$",
        "ValueError": "library/exceptions.html#$",
    },
}
NUMPY = {"py:class": {"numpy.ndarray": "reference/generated/numpy.ndarray.html#$"}}
SCIPY = {
    "py:class": {"scipy.spatial.ConvexHull": "reference/generated/scipy.spatial.ConvexHull.html#$"}
}
TORCH = {
    "py:class": {
        "torch.nn.LSTM": "generated/torch.nn.LSTM.html#$",
        "torch.optim.Adam": "generated/torch.optim.Adam.html#$",
    }
}


def inventory(project: str, names: dict[str, dict[str, str]]) -> bytes:
    """Return an inventory of version 2."""
    head = f"# Sphinx inventory version 2\n# Project: {project}\n# Version: \n"
    head += "# The remainder of this file is compressed using zlib.\n"
    lines = [
        f"{name} {kind} 1 {page} -\n"
        for kind, pages in names.items()
        for name, page in sorted(pages.items())
    ]
    return head.encode() + zlib.compress("".join(lines).encode(), 9)


if __name__ == "__main__":
    for project, names in {
        "python": PYTHON, "numpy": NUMPY, "scipy": SCIPY, "torch": TORCH,
    }.items():  # fmt: skip
        (HERE / f"{project}.inv").write_bytes(inventory(project, names))
