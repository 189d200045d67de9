"""Pieces from CAD: outline, height, mass, centre of mass and grip width of a closed mesh.

The mesh is turned so that the named face points down (up for a bottom). Its flat triangles within
``FLAT_MM`` of that end are the contact face. Volume and centre of mass are integrals over the mesh
of uniform density. Drawings give the outline alone, as the section of a prism.
"""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from xml.sax.saxutils import escape

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.affinity import translate

from touchdown.backend.config import parse_settings
from touchdown.backend.core import (
    FloatArray,
    InputError,
    disk_errors,
    parse_toml,
    read_limited,
    require_package,
    write_atomically,
)
from touchdown.backend.geometry import pieces
from touchdown.backend.geometry.drawings import read_drawing

if TYPE_CHECKING:
    import trimesh

MAX_BYTES = 64_000_000  # a binary STL of 1.2 million triangles
MAX_CORNERS = 400  # of one outline
SIZE_MM = (5.0, 300.0)  # least and largest plausible length of a piece
THIN_MM = 0.3  # least plausible width of a piece
UNITS_MM = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
FLAT_MM = 0.02  # a face is flat within this
FLAT_RAD = math.radians(0.5)
# A small face whose edge goes on at less than this angle is a facet of a round surface.
ROUND_RAD, ROUND_SHARE = math.radians(12.0), 0.2
CORNER_MM = 0.005  # corners nearer to the line of their neighbours are left out
LEAST_AREA_MM2 = 1.0  # of a face, and of its parts
LEAST_HOLE_MM2 = 0.05
MIN_CIRCLE_CORNERS, CIRCLE_MM = 20, 0.01  # corners of a circle, and spread of their radii
PAD_MM = 10.0  # half width of a pad along x
PICTURE_PX = 480
GRIP_OFF_MM = 0.5  # largest offset of the grip along y without a note
GRIP_SHARE = 0.7  # usual height of the grip as a share of the height
MAX_SEARCHED = 200_000  # triangles of a mesh that is searched for self-intersections
MAX_PAIRS = 60_000_000  # pairs of triangles whose boxes are compared
DENSITIES = "PLA 1.24, ABS 1.04, PETG 1.27, aluminium 2.70, steel 7.85"
PieceEnd = Literal["bottom", "top", "+x", "-x", "+y", "-y"]
PieceRole = Literal["top", "bottom", "both"]
CentreOfMass = Literal["uniform", "unknown"]
# Rotations that turn the named side of the mesh downwards.
TURNS: dict[PieceEnd, FloatArray] = {
    "bottom": np.eye(3),
    "top": np.diag([1.0, -1.0, -1.0]),
    "+x": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "-x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "+y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}


@dataclass(frozen=True, slots=True)
class PieceImport:
    """Options of reading a file.

    ``end``: side of the mesh that is the contact face. ``unit``: key of ``UNITS_MM``, by default
    the unit that a drawing names, else mm. One of ``density_g_cm3`` and ``mass_g`` is needed.
    ``height_mm`` is needed for drawings and refused for meshes. ``grip_mm``: height of the grip
    above the face, by default ``GRIP_SHARE`` of the height. ``com``: centre of mass of a uniform
    density, or unknown; by default unknown for a drawing with a mass, which gives no density.
    """

    end: PieceEnd | None = None
    role: PieceRole = "top"
    unit: str | None = None
    density_g_cm3: float | None = None
    mass_g: float | None = None
    height_mm: float | None = None
    grip_mm: float | None = None
    com: CentreOfMass | None = None


@dataclass(frozen=True, slots=True)
class MeasuredPiece:
    """Geometry of one piece, mm in the frame of its face: z up as it stands, origin at the centre.

    ``face`` and ``opposite``: polygons with holes and parts; ``com_mm`` (x, y, height above the
    underside), x and y NaN if unknown; ``grip_y_mm``: extent between the pads along y, None for a
    bottom; ``notes``: sentences for the operator.
    """

    role: PieceRole
    face: shapely.MultiPolygon
    opposite: shapely.MultiPolygon | None
    height_mm: float
    volume_mm3: float
    mass_g: float
    com_mm: tuple[float, float, float]
    grip_mm: float | None
    grip_y_mm: tuple[float, float] | None
    notes: tuple[str, ...] = ()

    @property
    def width_mm(self) -> float | None:
        """Width between the pads."""
        return None if self.grip_y_mm is None else self.grip_y_mm[1] - self.grip_y_mm[0]


def measure_piece(path: Path, wanted: PieceImport) -> MeasuredPiece:
    """Measure a piece.

    Parameters
    ----------
    path : Path
        Closed mesh (STL, OBJ, PLY, OFF) or drawing of the outline (SVG, DXF).
    wanted : PieceImport
        Face, role, unit, and density or mass.

    Returns
    -------
    MeasuredPiece
        Lengths in mm in the frame of the face, mass in g.

    Raises
    ------
    InputError
        One sentence for a file that cannot be used, with what to do: unreadable, too large, open or
        self-intersecting, of an unlikely size, or without a flat face at that end.

    """
    _check_numbers(wanted)
    kind = path.suffix.lower()
    if kind not in pieces.PIECE_SOURCES:
        known = ", ".join(pieces.PIECE_SOURCES)
        fix = f"Export the piece as one of {known}."
        raise InputError(f"Pieces cannot be read from '{kind or path.name}' files.", str(path), fix)
    limit = MAX_BYTES // 1_000_000
    content = read_limited(path, MAX_BYTES, f"Check the path, or export it below {limit} MB.")
    if kind in pieces.DRAWINGS:
        return _measure_drawing(path, content, wanted)
    if wanted.height_mm is not None:
        fix = "Leave it out, or give --units."
        raise InputError("The height of a mesh is measured.", "--height", fix)
    return _measure_mesh(_read_mesh(path, content), path, wanted)


def _check_numbers(wanted: PieceImport) -> None:
    if wanted.com == "unknown" and wanted.role != "top":
        fix = "Leave out --com, or give --role top."
        raise InputError("A bottom cannot be weighed by the hand.", "--com", fix)
    if (wanted.density_g_cm3 is None) == (wanted.mass_g is None):
        fix = f"Give --mass (g), or --density in g/cm³ ({DENSITIES})."
        raise InputError("A piece needs either a mass or a density.", "--mass, --density", fix)
    limits = {
        "--density": (wanted.density_g_cm3, 0.01, 25.0, "g/cm³"),
        "--mass": (wanted.mass_g, 0.1, 10_000.0, "g"),
        "--height": (wanted.height_mm, 1.0, SIZE_MM[1], "mm"),
        "--grip": (wanted.grip_mm, 0.1, SIZE_MM[1], "mm"),
    }
    for option, (value, low, high, unit) in limits.items():
        if value is not None and not low <= value <= high:
            fix = f"Give {low:g} to {high:g} {unit}."
            raise InputError(f"{option} {value:g} is out of range.", option, fix)


def _read_mesh(path: Path, content: bytes) -> trimesh.Trimesh:
    """Return the mesh with merged vertices, in the units of the file."""
    require_package("trimesh", "cad")
    import trimesh

    fix = "Export the piece again as a binary STL."
    if not content.strip(b"\0 \r\n\t"):
        raise InputError("The file is empty.", str(path), fix)
    try:
        kind = path.suffix.lower().lstrip(".")
        mesh = trimesh.load_mesh(io.BytesIO(content), file_type=kind, process=False)
        faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices, dtype=np.float64)
    except Exception as error:
        what = f"The file is not a readable {kind.upper()} mesh."
        raise InputError(what, str(path), fix) from error
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("The file holds no mesh of triangles.", str(path), fix)
    if not np.isfinite(vertices).all():
        count = int((~np.isfinite(vertices).all(axis=1)).sum())
        raise InputError(f"{count} corners of the mesh are not numbers.", str(path), fix)
    # Corners of an STL are written once for each triangle; equal ones are one vertex.
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-12)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(digits_vertex=7 - math.ceil(math.log10(size)))
    faces = np.asarray(mesh.faces)
    mesh.update_faces((faces != np.roll(faces, 1, axis=1)).all(axis=1))
    return mesh


def _measure_mesh(mesh: trimesh.Trimesh, path: Path, wanted: PieceImport) -> MeasuredPiece:
    import trimesh

    raw = np.ptp(mesh.vertices, axis=0)
    unit_mm = UNITS_MM[wanted.unit or "mm"]
    _check_size(raw * unit_mm, raw, path)
    mesh = trimesh.Trimesh(mesh.vertices * unit_mm, mesh.faces, process=False)
    _check_closed(mesh, path)
    notes = _check_intersections(mesh, path)
    carries = wanted.role == "bottom"
    end = wanted.end or ("top" if carries else "bottom")
    turn = TURNS["top"] @ TURNS[end] if carries else TURNS[end]
    corners = np.asarray(mesh.vertices) @ turn.T
    corners -= [0.0, 0.0, corners[:, 2].min()]
    mesh = trimesh.Trimesh(corners, mesh.faces, process=False)
    volume_mm3 = abs(float(mesh.volume))
    height_mm = float(corners[:, 2].max())
    face = _flat_end(mesh, height_mm if carries else 0.0, f"{end} end", path)
    opposite = None
    if wanted.role != "top":
        other = "end opposite to the face, on which it stands or which carries the next piece"
        opposite = _flat_end(mesh, 0.0 if carries else height_mm, other, path)
    com = np.asarray(mesh.center_mass, dtype=np.float64)
    if wanted.com == "unknown":
        com[:2] = math.nan
    mass_g = wanted.mass_g or 1e-3 * volume_mm3 * (wanted.density_g_cm3 or 0.0)
    x, y = _centre(face)
    grip_mm = _grip_height(wanted, height_mm)
    grip = None if grip_mm is None else _grip(mesh, grip_mm, x, path)
    measured = MeasuredPiece(
        wanted.role, translate(face, -x, -y), opposite and translate(opposite, -x, -y), height_mm,
        volume_mm3, mass_g, (float(com[0]) - x, float(com[1]) - y, float(com[2])), grip_mm,
        grip and (grip[0] - y, grip[1] - y), tuple(notes),
    )  # fmt: skip
    return _with_notes(measured)


def _measure_drawing(path: Path, content: bytes, wanted: PieceImport) -> MeasuredPiece:
    if wanted.height_mm is None:
        fix = "Give --height in mm, or use a mesh."
        raise InputError("A drawing holds no height.", str(path), fix)
    if wanted.end is not None:
        raise InputError("A drawing is one face.", "--face", "Leave it out, or use a mesh.")
    face = read_drawing(path, content, UNITS_MM[wanted.unit] if wanted.unit else None)
    raw = read_drawing(path, content, 1.0)
    _check_size(_size(face), _size(raw), path)
    face = _tidied(face, path)
    x, y = _centre(face)
    face, volume_mm3 = translate(face, -x, -y), face.area * wanted.height_mm
    mass_g = wanted.mass_g or 1e-3 * volume_mm3 * (wanted.density_g_cm3 or 0.0)
    grip = None
    grip_mm = _grip_height(wanted, wanted.height_mm)
    if grip_mm is not None:
        grip = _extent_y(face, path)
    com = face.centroid.x, face.centroid.y, 0.5 * wanted.height_mm
    drawn = "unknown" if wanted.role == "top" and wanted.mass_g is not None else "uniform"
    if (wanted.com or drawn) == "unknown":
        com = math.nan, math.nan, com[2]
    opposite = None if wanted.role == "top" else face
    return _with_notes(MeasuredPiece(
        wanted.role, face, opposite, wanted.height_mm, volume_mm3, mass_g, com, grip_mm, grip
    ))  # fmt: skip


def _size(area: Any) -> FloatArray:
    low_x, low_y, high_x, high_y = area.bounds
    return np.array([high_x - low_x, high_y - low_y])


def _check_size(size: FloatArray, raw: FloatArray, path: Path) -> None:
    """Raise ``InputError`` for an implausible ``size`` (mm), naming the units that would fit.

    ``raw`` is the size in units of the file.
    """
    largest = float(size.max())
    if SIZE_MM[0] <= largest <= SIZE_MM[1] and size.min() >= THIN_MM:
        return
    words = " x ".join(f"{value:.3g}" for value in size)
    what = f"The piece would be {words} mm, which is unlikely."
    if size.min() < THIN_MM and largest >= SIZE_MM[0]:
        raise InputError(what, str(path), "Export a solid body that is thick in all directions.")
    scaled = {name: raw * unit_mm for name, unit_mm in UNITS_MM.items()}
    sizes = " or ".join(
        f"--units {name} ({' x '.join(f'{v:.3g}' for v in mm)} mm)"
        for name, mm in scaled.items()
        if SIZE_MM[0] <= mm.max() <= SIZE_MM[1]
    )
    low, high = SIZE_MM
    fix = f"Give {sizes}." if sizes else f"Scale it to {low:g} to {high:g} mm."
    raise InputError(what, str(path), fix)


def _check_closed(mesh: trimesh.Trimesh, path: Path) -> None:
    """Raise ``InputError`` unless each edge joins two triangles of like orientation."""
    _, counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    if wrong := int((counts % 2 == 1).sum()):
        what = f"The mesh is open: {wrong} of its edges border on one triangle only."
        fix = "Close its holes in the CAD program, and export it again."
        raise InputError(what, str(path), fix)
    if not mesh.is_winding_consistent or not abs(mesh.volume) > 0.0:
        what = "The triangles of the mesh are not oriented alike."
        raise InputError(what, str(path), "Recompute its normals, and export it again.")


def _check_intersections(mesh: trimesh.Trimesh, path: Path) -> list[str]:
    """Raise ``InputError`` if an edge crosses a triangle; return a note if not searched."""
    unsearched = ["The mesh is too fine to be searched for self-intersections."]
    if len(mesh.faces) > MAX_SEARCHED:
        return unsearched
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    tree = shapely.STRtree(shapely.box(*low[:, :2].T, *high[:, :2].T))
    searched, step = 0, max(8, 2_000_000 // len(triangles))
    for start in range(0, len(triangles), step):
        one, other = tree.query(tree.geometries[start : start + step])
        one = one + start
        searched += len(one)
        if searched > MAX_PAIRS:
            return unsearched
        near = (one != other) & (low[one, 2] < high[other, 2]) & (low[other, 2] < high[one, 2])
        one, other = one[near], other[near]
        shared = (mesh.faces[one][:, :, None] == mesh.faces[other][:, None]).any(axis=(1, 2))
        one, other = one[~shared], other[~shared]
        if _crossings(triangles[one], triangles[other]).any():
            what = "The mesh intersects itself, so that its volume is not defined."
            fix = "Unite its bodies in the CAD program, and export it again."
            raise InputError(what, str(path), fix)
    return []


def _crossings(first: FloatArray, second: FloatArray) -> NDArray[np.bool_]:
    """Return (n,) bool: an edge of ``first`` (n, 3, 3) passes through the inside of ``second``."""
    a, b, c = second[:, None, 0], second[:, None, 1], second[:, None, 2]
    p, q = first, np.roll(first, -1, axis=1)

    def side(u: FloatArray, v: FloatArray, w: FloatArray, x: FloatArray) -> FloatArray:
        """Six times the volume of a tetrahedron, by the scale of its edges: a length, mm."""
        normal = np.cross(v - u, w - u)
        scale = np.linalg.norm(normal, axis=-1)
        distance = ((x - u) * normal).sum(axis=-1) / np.where(scale > 0.0, scale, 1.0)
        return np.asarray(np.where(np.abs(distance) < 1e-4, 0.0, distance))

    splits = side(a, b, c, p) * side(a, b, c, q) < 0.0
    turns = side(p, q, a, b), side(p, q, b, c), side(p, q, c, a)
    inside = np.logical_and.reduce([turn > 0.0 for turn in turns]) | np.logical_and.reduce(
        [turn < 0.0 for turn in turns]
    )
    return np.asarray((splits & inside).any(axis=1))


def _flat_end(mesh: trimesh.Trimesh, z_mm: float, end: str, path: Path) -> shapely.MultiPolygon:
    """Return the union of the triangles that lie within ``FLAT_MM`` of ``z_mm``."""
    triangles = np.asarray(mesh.triangles)
    level = np.abs(np.asarray(mesh.face_normals)[:, 2]) >= math.cos(FLAT_RAD)
    flat = level & (np.abs(triangles[:, :, 2] - z_mm) <= FLAT_MM).all(axis=1)
    shapes = shapely.polygons(triangles[flat, :, :2]) if flat.any() else np.empty(0, dtype=object)
    shapes = shapes[shapely.area(shapes) > 1e-9]
    union = shapely.union_all(shapes, grid_size=1e-4)
    x_mm, y_mm = np.ptp(np.asarray(mesh.vertices)[:, :2], axis=0)
    rounded = _rounded_share(mesh, flat) > 0.5 and union.area < ROUND_SHARE * x_mm * y_mm
    if union.area < LEAST_AREA_MM2 or rounded:
        what = f"There is no flat face at the {end}: {union.area:.2g} mm² lie in one plane."
        fix = "Name another side (--face), or turn the mesh so that the face is level."
        raise InputError(what, str(path), fix)
    if shapely.area(shapes).sum() > 1.001 * union.area + 0.01:
        what = f"Triangles of the face at the {end} overlap."
        fix = "Unite its bodies in the CAD program, and export it again."
        raise InputError(what, str(path), fix)
    return _tidied(union, path)


def _rounded_share(mesh: trimesh.Trimesh, flat: NDArray[np.bool_]) -> float:
    """Return the share of the edge of ``flat`` triangles where the surface goes on almost level."""
    edge = flat[mesh.face_adjacency].sum(axis=1) == 1
    ends = np.asarray(mesh.vertices)[mesh.face_adjacency_edges[edge]]
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    smooth = np.asarray(mesh.face_adjacency_angles)[edge] < ROUND_RAD
    return float(length[smooth].sum() / length.sum()) if length.any() else 0.0


def _tidied(area: Any, path: Path) -> shapely.MultiPolygon:
    """Return the polygons of ``area`` without superfluous corners, slivers and tiny holes."""
    parts = []
    for step in (CORNER_MM, 4 * CORNER_MM):
        whole = shapely.simplify(area, step)
        parts = [
            shapely.Polygon(
                p.exterior, [h for h in p.interiors if shapely.Polygon(h).area >= LEAST_HOLE_MM2]
            )
            for p in shapely.get_parts(whole)
            if p.geom_type == "Polygon" and p.area >= LEAST_AREA_MM2
        ]
        if shapely.get_num_coordinates(shapely.MultiPolygon(parts)) <= MAX_CORNERS:
            break
    else:
        what = f"The outline of the face has more than {MAX_CORNERS} corners."
        raise InputError(what, str(path), "Simplify the face, or export the mesh coarser.")
    if not parts:
        what = f"No part of the face is larger than {LEAST_AREA_MM2:g} mm²."
        raise InputError(what, str(path), "Check the unit (--units).")
    return shapely.orient_polygons(shapely.MultiPolygon(parts))


def _centre(face: shapely.MultiPolygon) -> tuple[float, float]:
    """Return the origin of the frame of a face: the middle of its extents, or its centroid.

    The centroid serves circles, and convex faces that do not contain the middle of their extents.
    """
    x_low, y_low, x_high, y_high = face.bounds
    middle = shapely.Point((x_low + x_high) / 2, (y_low + y_high) / 2)
    if circle := _circle(face):
        return circle[:2]
    point = middle if _convex(face) is None or face.contains(middle) else face.centroid
    return point.x, point.y


def _convex(face: shapely.MultiPolygon) -> FloatArray | None:
    """Return the corners (k, 2) of a convex face, counter-clockwise, None for another one."""
    hull = face.convex_hull
    if len(face.geoms) > 1 or face.geoms[0].interiors:
        return None
    if shapely.hausdorff_distance(hull, face) > CORNER_MM:
        return None
    return np.asarray(shapely.orient_polygons(hull).exterior.coords)[:-1]


def _circle(face: shapely.MultiPolygon) -> tuple[float, float, float] | None:
    """Return centre and radius of a face that is a finely divided circle."""
    corners = _convex(face)
    if corners is None or len(corners) < MIN_CIRCLE_CORNERS:
        return None
    centre = np.asarray(shapely.minimum_bounding_circle(face).centroid.coords[0])
    radius = np.hypot(*(corners - centre).T)
    if np.ptp(radius) > CIRCLE_MM:
        return None
    return float(centre[0]), float(centre[1]), float(radius.mean())


def _grip_height(wanted: PieceImport, height_mm: float) -> float | None:
    if wanted.role == "bottom":
        if wanted.grip_mm is not None:
            raise InputError("A bottom is not gripped.", "--grip", "Leave it out, or give --role.")
        return None
    if wanted.grip_mm is not None and wanted.grip_mm > height_mm:
        what = f"The grip at {wanted.grip_mm:g} mm lies above the piece ({height_mm:.1f} mm)."
        raise InputError(what, "--grip", "Give a height above the face within the piece.")
    return wanted.grip_mm or round(GRIP_SHARE * height_mm, 1)


def _grip(mesh: trimesh.Trimesh, z_mm: float, x_mm: float, path: Path) -> tuple[float, float]:
    """Return the extent along y between the pads at height ``z_mm``."""
    import trimesh

    level = trimesh.intersections.mesh_plane(  # type: ignore[no-untyped-call]
        mesh, (0.0, 0.0, 1.0), (0.0, 0.0, z_mm)
    )
    ends = np.asarray(level)[:, :, :2]
    lines = shapely.linestrings(ends - [x_mm, 0.0])
    return _extent_y(shapely.GeometryCollection(list(np.atleast_1d(lines))), path)


def _extent_y(section: Any, path: Path) -> tuple[float, float]:
    """Return the extent along y of the part of ``section`` between the pads."""
    between = section.intersection(shapely.box(-PAD_MM, -1e6, PAD_MM, 1e6))
    if between.is_empty or not between.bounds[3] > between.bounds[1]:
        fix = "Give another height of the grip (--grip) or another face."
        raise InputError("Nothing lies between the pads at the grip.", str(path), fix)
    return float(between.bounds[1]), float(between.bounds[3])


def _with_notes(piece: MeasuredPiece) -> MeasuredPiece:
    notes = list(piece.notes)
    x, y, z = (round(value, 6) + 0.0 for value in piece.com_mm)
    if math.isnan(x):
        notes.append(
            "The centre of mass is unknown: a run weighs the piece first (--weigh)."
            if piece.mass_g >= pieces.LEAST_WEIGHED_G
            else "The centre of mass is unknown, and a piece lighter than "
            f"{pieces.LEAST_WEIGHED_G:g} g cannot be weighed: enter com_xy_mm in its file."
        )
    elif not piece.face.convex_hull.contains(shapely.Point(piece.com_mm[:2])):
        notes.append("The centre of mass lies outside the face: the piece does not stand on it.")
    if piece.grip_y_mm is not None:
        off_mm = sum(piece.grip_y_mm) / 2
        if abs(off_mm) > GRIP_OFF_MM:
            notes.append(
                f"The middle between the pads lies {off_mm:+.1f} mm along y from that of the face."
            )
    return replace(piece, com_mm=(x, y, z), notes=tuple(notes))


def piece_toml(piece: MeasuredPiece, title: str) -> str:
    """Return the content of a piece file."""
    x, y, z = (round(value, 4) + 0.0 for value in piece.com_mm)
    com = '"unknown"' if math.isnan(x) else f"[{x:.4f}, {y:.4f}]"
    lines = [
        f"title = {json.dumps(title, ensure_ascii=False)}",
        f"roles = {json.dumps(['top', 'bottom'] if piece.role == 'both' else [piece.role])}",
        f"height_mm = {piece.height_mm:.4f}",
        f"com_height_mm = {min(z, piece.height_mm):.4f}",
        f"com_xy_mm = {com}",
        f"mass_g = {piece.mass_g:.3f}",
    ]
    if piece.grip_mm is not None and piece.width_mm is not None:
        lines += [f"grip_height_mm = {piece.grip_mm:.3f}", f"width_mm = {piece.width_mm:.3f}"]
    lines += ["nominal = true", f"face = {_face_table(piece.face)}"]
    if piece.opposite is not None:
        lines.append(f"opposite = {_face_table(piece.opposite)}")
    return "\n".join(lines) + "\n"


def _face_table(face: shapely.MultiPolygon) -> str:
    circle, corners = _circle(face), _convex(face)
    if circle and math.hypot(*circle[:2]) <= CIRCLE_MM:
        return f'{{ shape = "circle", diameter_mm = {2 * circle[2]:.4f} }}'
    if corners is not None and face.contains(shapely.Point(0.0, 0.0)):
        return f'{{ shape = "polygon", vertices_mm = {_points(corners)} }}'
    parts = [
        f"{{ exterior = {_points(part.exterior.coords[:-1])}, "
        f"holes = [{', '.join(_points(hole.coords[:-1]) for hole in part.interiors)}] }}"
        for part in face.geoms
    ]
    return f'{{ shape = "region", parts = [{", ".join(parts)}] }}'


def _points(corners: Any) -> str:
    return json.dumps((np.round(np.asarray(corners), 4) + 0.0).tolist())


def piece_svg(
    piece: MeasuredPiece,
    title: str,
    ink: str = "#1b1f24",
    paper: str = "#ffffff",
    letter_px: float = 14.0,
) -> str:
    """Return a picture: face with holes, opposite end, pads, centre of mass and scale bar.

    Without a ``title`` there are no sentences below it. Its width is ``PICTURE_PX``.
    """
    x_low, y_low, x_high, y_high = piece.face.bounds
    if piece.grip_y_mm is not None:
        y_low, y_high = min(y_low, piece.grip_y_mm[0]), max(y_high, piece.grip_y_mm[1])
        x_low, x_high = min(x_low, -PAD_MM), max(x_high, PAD_MM)
    size_mm = max(x_high - x_low, y_high - y_low)
    px, edge = PICTURE_PX * 0.84 / size_mm, 0.08 * PICTURE_PX

    def at(x_mm: float, y_mm: float) -> str:
        middle = (x_high + x_low) / 2
        return f"{PICTURE_PX / 2 + px * (x_mm - middle):.2f} {edge + px * (y_high - y_mm):.2f}"

    def path(face: shapely.MultiPolygon | None, style: str) -> str:
        rings = [] if face is None else [r for p in face.geoms for r in (p.exterior, *p.interiors)]
        data = "".join(f"M{'L'.join(at(*c) for c in ring.coords[:-1])}Z" for ring in rings)
        return f'<path d="{data}" {style}/>' if data else ""

    def text(x: float, y: float, words: str) -> str:
        return f'<text x="{x:.1f}" y="{y:.1f}">{escape(words)}</text>'

    x, y, z = (round(value, 2) + 0.0 for value in piece.com_mm)
    foot = edge + px * (y_high - y_low) + 14 + letter_px
    bar_mm = next(b for b in (100.0, 50.0, 20.0, 10.0, 5.0, 2.0, 1.0) if b <= 0.6 * size_mm)
    pads = "".join(
        f'<path d="M{at(-PAD_MM, y_mm)}L{at(PAD_MM, y_mm)}" stroke="#8a8f98" stroke-width="6"/>'
        for y_mm in piece.grip_y_mm or ()
    )
    grip = "" if piece.width_mm is None else f"grip {piece.width_mm:.1f} mm wide, "
    words: tuple[str, ...] = (
        f"{title}: {piece.height_mm:.1f} mm high, {piece.mass_g:.1f} g",
        f"{grip}face {piece.face.area:.1f} mm²",
        "centre of mass unknown"
        if math.isnan(x)
        else f"centre of mass {x:.2f}, {y:.2f} mm, {z:.2f} mm above the underside",
    )
    cross = "" if math.isnan(x) else (
        f'<path d="M{at(x, y)}m-12 0h24m-12 -12v24" stroke="#d6453d" stroke-width="3"/>'
    )  # fmt: skip
    words = words if title else ()
    high = f"{foot + (len(words) + 0.7) * (letter_px + 6):.0f}"
    lines = [text(16, foot + (1.3 + i) * (letter_px + 6), word) for i, word in enumerate(words)]
    dashed = 'stroke-dasharray="8"'
    face = 'fill="#4c8bd6" fill-opacity="0.45" fill-rule="evenodd"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{PICTURE_PX}" height="{high}" '
        f'viewBox="0 0 {PICTURE_PX} {high}">'
        f'<rect width="{PICTURE_PX}" height="{high}" fill="{paper}"/>'
        f'<g fill="none" stroke="{ink}" stroke-width="2">{path(piece.face, face)}'
        f"{path(piece.opposite, dashed)}{pads}{cross}"
        f'<path d="M16 {foot:.1f}h{px * bar_mm:.2f}" stroke-width="4"/></g>'
        f'<g font-family="sans-serif" font-size="{letter_px:.1f}" fill="{ink}">'
        f"{text(24 + px * bar_mm, foot + 0.35 * letter_px, f'{bar_mm:g} mm')}"
        f"{''.join(lines)}</g></svg>\n"
    )


def piece_name(path: Path) -> str:
    """Return a valid name for the piece of a file."""
    name = re.sub(r"[^a-z0-9_-]+", "-", path.stem.lower()).strip("-_")[:40]
    return name if pieces.PIECE_NAME.fullmatch(name) else f"piece-{name}"[:40].rstrip("-")


def save_piece(
    piece: MeasuredPiece, name: str, title: str = "", folder: Path | None = None
) -> tuple[Path, Path]:
    """Write piece file and picture to ``folder``, by default that of the operator's pieces.

    Returns
    -------
    tuple of Path
        The TOML file and the SVG picture.

    Raises
    ------
    InputError
        If the name is invalid or taken, or a file cannot be written. Nothing is overwritten.

    """
    if pieces.PIECE_NAME.fullmatch(name) is None:
        fix = "Use small letters, digits, '-' and '_', a letter first, at most 40."
        raise InputError(f"'{name}' cannot be the name of a piece.", "--name", fix)
    own = folder is None
    place = pieces.pieces_folder() if folder is None else folder
    written, picture = place / f"{name}.toml", place / f"{name}.svg"
    library = pieces.load_pieces()
    if (own and name in {*library.pieces, *library.broken}) or written.exists() or picture.exists():
        known = library.pieces.get(name)
        where = str(next((p for p in (written, picture) if p.exists()), known and known.source))
        raise InputError(f"There is already a piece '{name}'.", where, "Give another --name.")
    title = title or name.replace("-", " ").replace("_", " ").capitalize()
    text = piece_toml(piece, title)
    parse_settings(pieces.PieceFile, parse_toml(text), str(written))
    fix = "Name another folder (--out), or make room."
    with disk_errors("The piece cannot be written", place, fix):
        write_atomically(picture, piece_svg(piece, title).encode())
        write_atomically(written, text.encode())
    return written, picture
