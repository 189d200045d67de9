"""Outlines from drawings: closed curves of SVG and DXF files as polygons with holes.

Curves become chords with an error of at most ``CHORD_MM``. Curves inside others are holes, by the
even-odd rule. SVG follows the W3C recommendation (SVG 1.1, chapters 7 to 9): one unit is 1/96 inch,
unless the root has a size and a ``viewBox``; y points down and is mirrored. DXF follows Autodesk's
reference of the ASCII format; ``$INSUNITS`` gives the unit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from functools import reduce
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import shapely

from touchdown.backend.core import FloatArray, InputError

CHORD_MM = 0.005
MAX_CURVES = 500
MAX_NUMBER = 1e9
GAP_MM = 0.01  # ends of lines that meet
PX_MM = 25.4 / 96.0
SVG_UNITS_MM = {"": PX_MM, "px": PX_MM, "mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72.0}
DXF_UNITS_MM = {1: 25.4, 2: 304.8, 4: 1.0, 5: 10.0, 6: 1000.0, 13: 1e-3}  # of $INSUNITS
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
ARC_FLAGS = re.compile(rf"((?:{NUMBER.pattern}[\s,]+){{3}})([01])[\s,]*([01])")
COMMANDS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
IGNORED_DXF = {"TEXT", "MTEXT", "DIMENSION", "POINT", "HATCH", "VIEWPORT", "ATTDEF", "LEADER"}


def read_drawing(path: Path, content: bytes, unit_mm: float | None = None) -> shapely.Geometry:
    """Return the area inside the closed curves of a drawing, mm, y up.

    ``unit_mm``: length of a unit; by default the one that the file names. Raises ``InputError`` in
    one sentence for an unreadable or unsupported file, and for curves that are open or cross.
    """
    try:
        if path.suffix.lower() == ".svg":
            curves = _read_svg(content.decode("utf-8"), unit_mm)
        else:
            curves = _read_dxf(content.decode("utf-8", "replace"), unit_mm)
    except InputError:
        raise
    except (ValueError, IndexError, KeyError, OverflowError, ElementTree.ParseError) as error:
        what = f"The file is not a readable {path.suffix[1:].upper()} drawing: {error}."
        raise InputError(what, str(path), "Export the outline again.") from error
    if len(curves) > MAX_CURVES:
        what = f"The drawing holds {len(curves)} curves, more than {MAX_CURVES}."
        raise InputError(what, str(path), "Leave nothing in it but the outline.")
    return _area(curves, path)


def _area(curves: Sequence[FloatArray], path: Path) -> shapely.Geometry:
    """Return the area inside an odd number of ``curves`` (k, 2)."""
    rings = []
    for curve in _joined(curves):
        gap_mm = math.hypot(*(curve[-1] - curve[0]))
        if gap_mm > GAP_MM:
            x, y = curve[0]
            what = (
                f"The outline is open: a curve that begins at {x:.2f}, {y:.2f} mm does not close."
            )
            raise InputError(what, str(path), "Close it, and leave out construction lines.")
        corners = curve[np.r_[True, np.hypot(*np.diff(curve, axis=0).T) > 1e-6]]
        ring = np.vstack([corners[:-1], corners[:1]]) if len(corners) > 3 else corners[:0]
        if len(ring):
            rings.append(shapely.Polygon(ring))
    if not rings:
        fix = "Export the outline as closed curves."
        raise InputError("The drawing holds no closed curve.", str(path), fix)
    for i, ring in enumerate(rings):
        meets = [ring.exterior.intersection(r.exterior) for r in rings[:i] if _cross(ring, r)]
        if meets or not ring.is_valid:
            # The reason of GEOS ends with the place: "Self-intersection[5 -5]".
            where = meets[0].representative_point() if meets else None
            x, y = where.coords[0] if where else _numbers(shapely.is_valid_reason(ring)[5:])[:2]
            what = f"The outline intersects itself near {x:.2f}, {y:.2f} mm."
            raise InputError(what, str(path), "Unite its parts in the drawing program.")
    area = reduce(shapely.symmetric_difference, rings)
    if area.is_empty:
        fix = "Leave out curves that are drawn twice."
        raise InputError("The curves of the drawing enclose nothing.", str(path), fix)
    return area


def _cross(one: shapely.Polygon, other: shapely.Polygon) -> bool:
    return bool(one.exterior.crosses(other.exterior))


def _joined(curves: Sequence[FloatArray]) -> list[FloatArray]:
    """Join open curves whose ends meet within ``GAP_MM``."""
    done: list[FloatArray] = []
    open_: list[FloatArray] = []
    for curve in curves:
        closed = len(curve) > 2 and math.hypot(*(curve[-1] - curve[0])) <= GAP_MM
        (done if closed else open_).append(curve)
    while open_:
        curve, joined = open_.pop(), True
        while joined and math.hypot(*(curve[-1] - curve[0])) > GAP_MM:
            joined = False
            for i, other in enumerate(open_):
                if math.hypot(*(other[0] - curve[-1])) > GAP_MM:
                    other = other[::-1]
                if math.hypot(*(other[0] - curve[-1])) <= GAP_MM:
                    curve, joined = np.vstack([curve, other[1:]]), True
                    del open_[i]
                    break
        done.append(curve)
    return done


def _arc(radius: float, angle_rad: float, scale_mm: float) -> FloatArray:
    """Return shares (n,) in 0 to 1 that divide an arc into chords within ``CHORD_MM``."""
    ratio = min(CHORD_MM / max(radius * scale_mm, CHORD_MM), 1.0)
    step = 2.0 * math.acos(1.0 - ratio) if ratio < 1.0 else math.pi / 2
    return np.linspace(0.0, 1.0, min(max(math.ceil(abs(angle_rad) / step), 4), 2000) + 1)


def _number(text: str) -> float:
    """Return a number; raises ``ValueError`` unless it is at most ``MAX_NUMBER``."""
    if not abs(number := float(text)) <= MAX_NUMBER:
        raise ValueError(f"the number {text} is out of range")
    return number


def _numbers(text: str) -> list[float]:
    return [_number(number) for number in NUMBER.findall(text)]


# -- SVG ------------------------------------------------------------------------------------------


def _read_svg(text: str, unit_mm: float | None) -> list[FloatArray]:
    if "<!ENTITY" in text or ("<!DOCTYPE" in text and "[" in text.split(">", 1)[0]):
        raise ValueError("it declares entities")
    root = ElementTree.fromstring(text)  # noqa: S314 - without declarations nothing can swell
    if root.tag.rpartition("}")[2] != "svg":
        raise ValueError("it has no svg element")
    x_scale = y_scale = scale = unit_mm or PX_MM
    box = _numbers(root.get("viewBox", ""))
    if unit_mm is None and len(box) == 4 and box[2] > 0.0 and box[3] > 0.0:
        wide, high = _length_mm(root.get("width")), _length_mm(root.get("height"))
        x_scale = wide / box[2] if wide else (high / box[3] if high else scale)
        y_scale = high / box[3] if high else x_scale
        # The default of preserveAspectRatio.
        if root.get("preserveAspectRatio", "").strip() != "none":
            x_scale = y_scale = min(x_scale, y_scale)
    whole = np.diag([x_scale, -y_scale, 1.0])
    return list(_svg_curves(root, whole, 0))


def _length_mm(text: str | None) -> float:
    """Return a length of the root element, 0 for none and for a percentage."""
    found = re.fullmatch(rf"\s*({NUMBER.pattern})\s*([a-z]*)\s*", text or "")
    return _number(found[1]) * SVG_UNITS_MM[found[2]] if found else 0.0


def _svg_curves(
    element: ElementTree.Element, matrix: FloatArray, depth: int
) -> Iterator[FloatArray]:
    """Yield the curves of an element and its children, transformed to mm."""
    if depth > 64:
        raise ValueError("it is nested too deeply")
    matrix = matrix @ _transform(element.get("transform", ""))
    style = f"{element.get('style', '')};display:{element.get('display', '')}"
    kind = element.tag.rpartition("}")[2]
    if kind in ("defs", "clipPath", "mask", "symbol", "pattern", "marker", "metadata"):
        return
    if re.search(r"display\s*:\s*none", style):
        return
    if kind in ("use", "image", "text"):
        raise ValueError(f"'{kind}' elements are not supported, convert them to paths")
    scale = math.sqrt(abs(float(np.linalg.det(matrix[:2, :2]))))
    for curve in _svg_shape(kind, element, scale):
        yield curve @ matrix[:2, :2].T + matrix[:2, 2]
    for child in element:
        yield from _svg_curves(child, matrix, depth + 1)


def _svg_shape(kind: str, element: ElementTree.Element, scale: float) -> Iterator[FloatArray]:
    def value(name: str, otherwise: float = 0.0) -> float:
        text = element.get(name)
        found = None if text is None else NUMBER.match(text.strip())
        return otherwise if found is None else _number(found[0])

    if kind in ("circle", "ellipse"):
        r_x, r_y = (value("r"),) * 2 if kind == "circle" else (value("rx"), value("ry"))
        turn = 2 * math.pi * _arc(max(r_x, r_y), 2 * math.pi, scale)
        yield np.column_stack([value("cx") + r_x * np.cos(turn), value("cy") + r_y * np.sin(turn)])
    elif kind == "rect":
        x, y, w, h = (value(name) for name in ("x", "y", "width", "height"))
        r_x = value("rx", value("ry"))
        r_x, r_y = min(r_x, w / 2), min(value("ry", r_x), h / 2)
        corner = f"a{r_x} {r_y} 0 0 1"
        yield from _path_curves(
            f"M{x + r_x} {y}h{w - 2 * r_x}{corner} {r_x} {r_y}v{h - 2 * r_y}{corner} {-r_x} {r_y}"
            f"h{2 * r_x - w}{corner} {-r_x} {-r_y}v{2 * r_y - h}{corner} {r_x} {-r_y}z", scale
        )  # fmt: skip
    elif kind in ("polygon", "polyline"):
        points = np.array(_numbers(element.get("points", "")))
        corners = points.reshape(-1, 2)
        yield np.vstack([corners, corners[:1]]) if kind == "polygon" else corners
    elif kind == "line":
        yield np.array([[value("x1"), value("y1")], [value("x2"), value("y2")]])
    elif kind == "path":
        yield from _path_curves(element.get("d", ""), scale)


def _transform(text: str) -> FloatArray:
    """Return the 3 x 3 matrix of a ``transform`` attribute."""
    whole = np.eye(3)
    for name, inner in re.findall(r"(\w+)\s*\(([^)]*)\)", text):
        v = _numbers(inner)
        one = np.eye(3)
        if name == "matrix":
            one[:2] = np.array(v).reshape(3, 2).T
        elif name == "translate":
            one[:2, 2] = v[0], (v[1] if len(v) > 1 else 0.0)
        elif name == "scale":
            one[0, 0], one[1, 1] = v[0], v[-1]
        elif name == "rotate":
            c, s = math.cos(math.radians(v[0])), math.sin(math.radians(v[0]))
            centre = np.array(v[1:3] if len(v) > 2 else (0.0, 0.0))
            one[:2, :2] = [[c, -s], [s, c]]
            one[:2, 2] = centre - one[:2, :2] @ centre
        elif name in ("skewX", "skewY"):
            one[("X" not in name) * 1, ("X" in name) * 1] = math.tan(math.radians(v[0]))
        else:
            raise ValueError(f"the transform '{name}' is unknown")
        whole = whole @ one
    return whole


def _path_curves(data: str, scale: float) -> Iterator[FloatArray]:
    """Yield the subpaths (k, 2) of path data; ``scale`` mm a unit."""
    at = start = np.zeros(2)
    bend: FloatArray | None = None  # control point of the curve before
    last, points = "", [at]
    for command, values in _path_commands(data):
        base, kind = (at if command.islower() else np.zeros(2)), command.upper()
        before, bend = bend, None
        if kind in "MZ":
            if len(points) > 1:
                yield np.array([*points, start] if kind == "Z" else points)
            at = start = base + values if kind == "M" else start
            points = [at]
        elif kind in "LHV":
            end = at.copy()
            if kind == "L":
                end = base + values
            else:
                axis = "HV".index(kind)
                end[axis] = base[axis] + values[0]
            points.append(end)
        elif kind == "A":
            points += _elliptic(at, base + values[5:], values, scale)
        else:
            ends = base + np.array(values).reshape(-1, 2)
            if kind in "ST":
                smooth = before is not None and last in ("CS" if kind == "S" else "QT")
                ends = np.vstack([2 * at - before if smooth and before is not None else at, ends])
            points += _bezier(np.vstack([at, ends]), scale)
            bend = ends[-2]
        at, last = points[-1], kind
    if len(points) > 1:
        yield np.array(points)


def _path_commands(data: str) -> Iterator[tuple[str, list[float]]]:
    """Yield command letters and their values; a repeated M is an L."""
    for letter, inner in re.findall(r"([A-Za-z])([^A-DF-Za-df-z]*)", data):
        count = COMMANDS.get(letter.upper())
        if count is None:
            raise ValueError(f"the path command '{letter}' is unknown")
        if letter in "Aa":
            # The flags may stand without a gap before the next number.
            inner = re.sub(
                rf"((?:{NUMBER.pattern}[\s,]*){{3}})([01])[\s,]*([01])", r"\1 \2 \3 ", inner
            )
        values = _numbers(inner)
        if (count and len(values) % count) or (not values) != (not count):
            raise ValueError(f"the path command '{letter}' has {len(values)} values")
        if not count:
            yield letter, []
        for i in range(0, len(values), count or 1):
            yield (
                (letter if i == 0 else letter.replace("M", "L").replace("m", "l")),
                values[i : i + count],
            )


def _bezier(control: FloatArray, scale: float) -> list[FloatArray]:
    """Return points of a Bézier curve after its first, by de Casteljau's construction."""
    length = float(np.hypot(*np.diff(control, axis=0).T).sum()) * scale
    share = np.linspace(0.0, 1.0, min(max(8, math.ceil(math.sqrt(length / CHORD_MM))), 500) + 1)
    rows = control[:, None, :] + np.zeros((1, len(share), 1))
    while len(rows) > 1:
        rows = rows[:-1] + share[None, :, None] * np.diff(rows, axis=0)
    return list(rows[0, 1:])


def _elliptic(
    start: FloatArray, end: FloatArray, values: Sequence[float], scale: float
) -> list[FloatArray]:
    """Return points of an elliptical arc after its first (SVG 1.1, appendix F.6)."""
    r_x, r_y, turn = abs(values[0]), abs(values[1]), math.radians(values[2])
    large, sweep = values[3] != 0.0, values[4] != 0.0
    if not (r_x and r_y) or np.array_equal(start, end):
        return [end]
    axes = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    half = axes @ (start - end) / 2 / [r_x, r_y]
    size = float(half @ half)
    grow = max(1.0, math.sqrt(size))
    r_x, r_y, half = r_x * grow, r_y * grow, half / grow
    reach = math.sqrt(max(1.0 / float(half @ half) - 1.0, 0.0)) * (1.0 if large != sweep else -1.0)
    middle = reach * np.array([half[1], -half[0]])
    first, last = half - middle, -half - middle
    begin = math.atan2(first[1], first[0])
    angle = math.atan2(last[1], last[0]) - begin
    angle += 2 * math.pi * ((sweep and angle < 0.0) - (not sweep and angle > 0.0))
    at = begin + angle * _arc(max(r_x, r_y), angle, scale)[1:]
    local = np.column_stack([np.cos(at), np.sin(at)]) + middle
    points = (local * [r_x, r_y]) @ axes + (start + end) / 2
    return [*points[:-1], end]


# -- DXF ------------------------------------------------------------------------------------------


def _read_dxf(text: str, unit_mm: float | None) -> list[FloatArray]:
    if text.startswith("AutoCAD Binary DXF"):
        raise ValueError("it is binary, save it as ASCII DXF")
    lines = text.splitlines()
    pairs = [
        (int(code), value.strip()) for code, value in zip(lines[::2], lines[1::2], strict=False)
    ]
    names = [value for code, value in pairs if code == 2]
    if "ENTITIES" not in names:
        raise ValueError("it has no section ENTITIES")
    scale = unit_mm or 1.0
    for (_, name), (code, value) in pairwise(pairs):
        if name == "$INSUNITS" and code == 70 and unit_mm is None:
            scale = DXF_UNITS_MM.get(int(value), 1.0)
    begin = pairs.index((2, "ENTITIES"))
    entities: list[tuple[str, list[tuple[int, str]]]] = []
    for code, value in pairs[begin + 1 :]:
        if code == 0 and value == "ENDSEC":
            break
        if code == 0:
            entities.append((value, []))
        elif entities:
            entities[-1][1].append((code, value))
    return list(_dxf_curves(entities, scale))


def _dxf_curves(
    entities: Sequence[tuple[str, list[tuple[int, str]]]], scale: float
) -> Iterator[FloatArray]:
    corners: list[tuple[float, float, float]] | None = None  # x, y, bulge of a POLYLINE
    closed = False
    for kind, pairs in entities:
        values = dict(reversed(pairs))
        number = {c: _number(v) for c, v in values.items() if 10 <= c <= 59}
        if float(values.get(230, "1")) < 0.0:
            raise ValueError(f"a {kind} is drawn from below")
        if kind == "POLYLINE":
            corners, closed = [], bool(int(values.get(70, "0")) & 1)
        elif kind == "VERTEX" and corners is not None:
            corners.append((number[10], number[20], number.get(42, 0.0)))
        elif kind == "SEQEND" and corners is not None:
            yield scale * _bulged(corners, closed, scale)
            corners = None
        elif kind == "LWPOLYLINE":
            yield scale * _bulged(_lw_corners(pairs), bool(int(values.get(70, "0")) & 1), scale)
        elif kind == "LINE":
            yield scale * np.array([[number[10], number[20]], [number[11], number[21]]])
        elif kind in ("CIRCLE", "ARC"):
            begin, end = (
                (math.radians(number[50]), math.radians(number[51])) if kind == "ARC" else (0, 0)
            )
            span = (end - begin) % (2 * math.pi) or 2 * math.pi
            turn = begin + span * _arc(number[40], span, scale)
            ring = np.column_stack([np.cos(turn), np.sin(turn)])
            yield scale * (np.array([number[10], number[20]]) + number[40] * ring)
        elif kind not in IGNORED_DXF:
            raise ValueError(f"{kind} entities are not supported, convert them to polylines")


def _lw_corners(pairs: Sequence[tuple[int, str]]) -> list[tuple[float, float, float]]:
    corners: list[tuple[float, float, float]] = []
    for code, value in pairs:
        if code == 10:
            corners.append((_number(value), math.nan, 0.0))
        elif code == 20 and corners:
            corners[-1] = corners[-1][0], _number(value), 0.0
        elif code == 42 and corners:
            corners[-1] = *corners[-1][:2], _number(value)
    return corners


def _bulged(
    corners: Sequence[tuple[float, float, float]], closed: bool, scale: float
) -> FloatArray:
    """Return the points of a polyline; a bulge is the tangent of a quarter of an arc's angle."""
    ends = [*corners[1:], corners[0]] if closed else corners[1:]
    points = [np.array(corners[0][:2])]
    for (x, y, bulge), stop in zip(corners, ends, strict=False):
        one, two = np.array([x, y]), np.array(stop[:2])
        if bulge:
            angle, chord = 4.0 * math.atan(bulge), two - one
            across = np.array([-chord[1], chord[0]])
            centre = (one + two) / 2 + across * (1.0 - bulge**2) / (4.0 * bulge)
            share = angle * _arc(float(np.hypot(*(one - centre))), angle, scale)[1:-1]
            c, s = np.cos(share), np.sin(share)
            u, v = one - centre
            points += list(np.column_stack([c * u - s * v, s * u + c * v]) + centre)
        points.append(two)
    return np.array(points)
