"""Write the inventories of other projects, so that ``make docs`` needs no network.

Each holds the names that our pages refer to, with their pages. Add a line below and run
``.venv/bin/python docs/_inventories/write.py``. ``make docs-links`` checks the addresses.
"""

import zlib
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Kind of the object, page ($: the name), names.
NAMES = {
    "python": [
        ("py:class", "library/functions.html#$", "bool float int"),
        ("py:class", "library/stdtypes.html#$", "dict list str tuple"),
        ("py:class", "library/pathlib.html#$", "pathlib.Path"),
        ("py:data", "library/constants.html#$", "False None True"),
        ("py:function", "library/functions.html#$", "callable"),
        ("std:label", "library/stdtypes.html#$", "bltin-boolean-values"),
        ("std:term", "glossary.html#term-$", "iterable iterator mapping sequence"),
    ],
    "numpy": [("py:class", "reference/generated/$.html#$", "numpy.ndarray")],
    "scipy": [("py:class", "reference/generated/$.html#$", "scipy.spatial.ConvexHull")],
    "torch": [("py:class", "generated/$.html#$", "torch.nn.LSTM torch.optim.Adam")],
}
HEAD = """\
# Sphinx inventory version 2
# Project: {}
# Version:
# The remainder of this file is compressed using zlib.
"""


def inventory(project: str) -> bytes:
    """Return the inventory of a project, in version 2 of the format of Sphinx."""
    lines = [
        f"{name} {kind} 1 {page.replace('$', name)} -\n"
        for kind, page, names in NAMES[project]
        for name in names.split()
    ]
    return HEAD.format(project).encode() + zlib.compress("".join(lines).encode(), 9)


if __name__ == "__main__":
    for each in NAMES:
        (HERE / f"{each}.inv").write_bytes(inventory(each))
