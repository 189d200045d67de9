"""Drawings that come in a file: whoever wrote it, they only draw."""

from __future__ import annotations

from xml.etree import ElementTree

ELEMENTS = frozenset(
    ("svg", "g", "image", "polygon", "polyline", "path", "rect", "circle", "line", "text")
)
INSIDE = "data:image/png;base64,"


def harmless(svg: str) -> str:
    """Return ``svg`` if it is one element that draws and loads nothing; raises ValueError."""
    if "<!" in svg or "<?" in svg:
        raise ValueError("a drawing declares something")
    try:
        root = ElementTree.fromstring(svg)  # noqa: S314 - without declarations nothing can swell
    except ElementTree.ParseError as error:
        raise ValueError(f"a drawing is damaged: {error}") from error
    if root.tag != "svg":
        raise ValueError("a drawing is no svg element")
    for element in root.iter():
        if element.tag not in ELEMENTS:
            raise ValueError(f"a drawing holds '{element.tag}'")
        for name, value in element.attrib.items():
            loads = name.endswith("href") and not value.startswith(INSIDE)
            if name.startswith("on") or loads or "url(" in value:
                raise ValueError(f"a drawing does more than draw: '{name}'")
    return svg
