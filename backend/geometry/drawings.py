"""Outlines from drawings: closed curves of SVG and DXF files as polygons with holes.

svgelements reads SVG, ezdxf reads DXF. Curves become chords with an error of at most ``CHORD_MM``.
Curves inside others are holes, by the even-odd rule. One unit of an SVG file is 1/96 inch, unless
the root has a size and a ``viewBox``; y points down and is mirrored. ``$INSUNITS`` gives the unit
of a DXF file.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import reduce
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import shapely

from touchdown.backend.core import FloatArray, InputError, require_package

CHORD_MM = 0.005
MAX_CURVES = 500
MAX_MM = 1e9
GAP_MM = 0.01  # ends of lines that meet
PX_MM = 25.4 / 96.0
SVG_UNITS_MM = {"": PX_MM, "px": PX_MM, "mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72.0}
ARC_CURVES = 32  # Bézier curves of a full circle of a DXF file
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
COMMANDS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
TRANSFORMS = {"matrix", "translate", "scale", "rotate", "skewX", "skewY"}
UNDRAWN_SVG = {"defs", "clipPath", "mask", "symbol", "pattern", "marker", "metadata"}
IGNORED_DXF = {"TEXT", "MTEXT", "DIMENSION", "POINT", "HATCH", "VIEWPORT", "ATTDEF", "LEADER"}


def read_drawing(path: Path, content: bytes, unit_mm: float | None = None) -> shapely.Geometry:
    """Return the area inside the closed curves of a drawing, mm, y up.

    ``unit_mm``: length of a unit; by default the one that the file names. Raises ``InputError`` in
    one sentence for an unreadable or unsupported file, and for curves that are open or cross.
    """
    require_package("svgelements" if path.suffix.lower() == ".svg" else "ezdxf", "cad")
    read = _read_svg if path.suffix.lower() == ".svg" else _read_dxf
    try:
        with np.errstate(all="ignore"):  # of numbers that are refused below
            curves = list(read(content, unit_mm))
    except Exception as error:
        what = f"The file is not a readable {path.suffix[1:].upper()} drawing: {error}."
        raise InputError(what, str(path), "Export the outline again.") from error
    if len(curves) > MAX_CURVES:
        what = f"The drawing holds {len(curves)} curves, more than {MAX_CURVES}."
        raise InputError(what, str(path), "Leave nothing in it but the outline.")
    if not all((np.abs(curve) <= MAX_MM).all() for curve in curves):
        fix = "Export the outline again."
        raise InputError("A coordinate of the drawing is out of range.", str(path), fix)
    return _area(curves, path)


def _area(curves: Sequence[FloatArray], path: Path) -> shapely.Geometry:
    """Return the area inside an odd number of ``curves`` (k, 2)."""
    rings = []
    for curve in _joined(curves):
        if not curve.is_closed:
            x, y = curve.coords[0]
            what = (
                f"The outline is open: a curve that begins at {x:.2f}, {y:.2f} mm does not close."
            )
            raise InputError(what, str(path), "Close it, and leave out construction lines.")
        if len(curve.coords) > 3:
            rings.append(shapely.Polygon(curve))
    if not rings:
        fix = "Export the outline as closed curves."
        raise InputError("The drawing holds no closed curve.", str(path), fix)
    for i, ring in enumerate(rings):
        edge = ring.exterior
        meets = [edge.intersection(r.exterior) for r in rings[:i] if edge.crosses(r.exterior)]
        if meets or not ring.is_valid:
            # The reason of GEOS ends with the place: "Self-intersection[5 -5]".
            reason = shapely.is_valid_reason(ring).partition("[")[2]
            where = meets[0].representative_point().coords[0] if meets else NUMBER.findall(reason)
            x, y = map(float, where[:2])
            what = f"The outline intersects itself near {x:.2f}, {y:.2f} mm."
            raise InputError(what, str(path), "Unite its parts in the drawing program.")
    area = reduce(shapely.symmetric_difference, rings)
    if area.is_empty:
        fix = "Leave out curves that are drawn twice."
        raise InputError("The curves of the drawing enclose nothing.", str(path), fix)
    return area


def _joined(curves: Sequence[FloatArray]) -> list[shapely.LineString]:
    """Return lines, joined where ends meet within ``GAP_MM``."""
    if not curves:
        return []
    ends = np.array([curve[at] for curve in curves for at in (0, -1)])
    near = np.hypot(*(ends[:, None] - ends).transpose(2, 0, 1)) <= GAP_MM
    ends = ends[near.argmax(axis=1)].reshape(-1, 2, 2)
    lines = [
        shapely.LineString(np.vstack([first, curve[1:-1], last]))
        for curve, (first, last) in zip(curves, ends, strict=True)
    ]
    merged = shapely.line_merge(shapely.MultiLineString(lines))
    return list(shapely.get_parts(shapely.remove_repeated_points(merged, 1e-6)))


def _read_svg(content: bytes, unit_mm: float | None) -> Iterator[FloatArray]:
    from svgelements import SVG, Shape

    text = content.decode("utf-8")
    if "<!ENTITY" in text or ("<!DOCTYPE" in text and "[" in text.split(">", 1)[0]):
        raise ValueError("it declares entities")
    root = ElementTree.fromstring(text)  # noqa: S314 - without declarations nothing can swell
    if root.tag.rpartition("}")[2] != "svg":
        raise ValueError("it has no svg element")
    scale_mm = _root_scale(root, unit_mm)
    for name in ("width", "height", "viewBox"):
        root.attrib.pop(name, None)
    _check_elements(root)
    drawing = SVG.parse(io.BytesIO(ElementTree.tostring(root)), reify=False)
    for shape in drawing.elements(lambda element: isinstance(element, Shape)):
        m = shape.transform
        turn = np.array([[m.a, m.c], [m.b, m.d]])
        # Arcs of svgelements do not follow a shear, so that points are transformed, not segments.
        for points in _subpaths(shape.segments(transformed=False), turn * scale_mm):
            yield (points @ turn.T + [m.e, m.f]) * scale_mm * [1.0, -1.0]


def _root_scale(root: ElementTree.Element, unit_mm: float | None) -> FloatArray:
    """Return the lengths (2,) in mm of a unit along x and y."""
    box = [float(value) for value in re.split(r"[\s,]+", root.get("viewBox", "").strip()) if value]
    if unit_mm is not None or len(box) != 4 or not (box[2] > 0.0 and box[3] > 0.0):
        return np.full(2, unit_mm or PX_MM)
    sizes = [
        re.fullmatch(rf"\s*({NUMBER.pattern})\s*([a-z]*)\s*", root.get(side, ""))
        for side in ("width", "height")
    ]
    scales = [
        float(size[1]) * SVG_UNITS_MM[size[2]] / along
        for size, along in zip(sizes, box[2:], strict=True)
        if size
    ] or [PX_MM]
    # The default of preserveAspectRatio fits the drawing into its window.
    fitted = root.get("preserveAspectRatio", "").strip() != "none"
    return np.full(2, min(scales)) if fitted else np.array([scales[0], scales[-1]])


def _check_elements(parent: ElementTree.Element, depth: int = 0) -> None:
    """Remove what is not drawn; raises ``ValueError`` for unsupported elements and values."""
    if depth > 64:
        raise ValueError("it is nested too deeply")
    for child in list(parent):
        kind = child.tag.rpartition("}")[2]
        if kind in UNDRAWN_SVG:
            parent.remove(child)
        elif kind in ("use", "image", "text"):
            raise ValueError(f"'{kind}' elements are not supported, convert them to paths")
        else:
            for name in re.findall(r"(\w+)\s*\(", child.get("transform", "")):
                if name not in TRANSFORMS:
                    raise ValueError(f"the transform '{name}' is unknown")
            _check_path(child.get("d", "") if kind == "path" else "")
            _check_elements(child, depth + 1)


def _check_path(data: str) -> None:
    """Raise ``ValueError`` for path data that svgelements would cut off."""
    for letter, inner in re.findall(r"([A-Za-z])([^A-DF-Za-df-z]*)", data):
        count = COMMANDS.get(letter.upper())
        if count is None:
            raise ValueError(f"the path command '{letter}' is unknown")
        values = NUMBER.findall(inner)
        # The flags of an arc may stand without a gap before the next number.
        if letter not in "Aa" and ((count and len(values) % count) or (not values) != (not count)):
            raise ValueError(f"the path command '{letter}' has {len(values)} values")


def _subpaths(segments: Iterable[Any], matrix: FloatArray) -> Iterator[FloatArray]:
    """Yield the points (k, 2) of subpaths; ``matrix`` turns their units into mm."""
    from svgelements import Close, Line, Move

    points: list[FloatArray] = []
    for segment in segments:
        end = np.atleast_2d(np.array(segment.end, dtype=np.float64))
        if isinstance(segment, Move):
            if len(points) > 1:
                yield np.vstack(points)
            points = [end]
        elif isinstance(segment, Line | Close):
            points.append(end)
            if isinstance(segment, Close):
                yield np.vstack(points)
                points = [end]
        else:
            coarse = segment.npoint(np.linspace(0.0, 1.0, 17)) @ matrix.T
            # A chord over a step h lies within h² / 8 times the second derivative.
            bend = 256.0 * np.hypot(*np.diff(coarse, 2, axis=0).T).max()
            count = min(max(math.ceil(math.sqrt(bend / (8.0 * CHORD_MM))), 4), 2000)
            points.append(segment.npoint(np.linspace(0.0, 1.0, count + 1)[1:]))
    if len(points) > 1:
        yield np.vstack(points)


def _read_dxf(content: bytes, unit_mm: float | None) -> Iterator[FloatArray]:
    import ezdxf.path
    from ezdxf import recover
    from ezdxf.enums import InsertUnits
    from ezdxf.units import conversion_factor

    if content.startswith(b"AutoCAD Binary DXF"):
        raise ValueError("it is binary, save it as ASCII DXF")
    document, audit = recover.read(io.BytesIO(content))
    if lost := [fix.message for fix in audit.fixes if fix.message.startswith("Deleted entity")]:
        raise ValueError(lost[0].rstrip("."))
    named = InsertUnits(document.units)
    scale = unit_mm or (conversion_factor(named, InsertUnits.Millimeters) if named else 1.0)
    for entity in document.modelspace():
        kind = entity.dxftype()
        if kind in IGNORED_DXF:
            continue
        try:
            path = ezdxf.path.make_path(entity, segments=ARC_CURVES)
        except TypeError as error:
            what = f"{kind} entities are not supported, convert them to polylines"
            raise ValueError(what) from error
        points = scale * np.array([point.xyz for point in path.flattening(CHORD_MM / scale)])
        if len(points) and np.ptp(points[:, 2]) > GAP_MM:
            raise ValueError(f"a {kind} does not lie in the plane of the drawing")
        yield points[:, :2]
