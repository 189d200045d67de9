"""Library of pieces and bottoms, one TOML file each, identified by content.

The name of a piece is the name of its file. ``touchdown piece add`` writes further pieces to the
data folder. Another folder of the operator's own files extends both; a file of the same name
replaces theirs. Every bad value is reported with its key.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from importlib.resources import files
from math import hypot, isfinite, nan, radians
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

from pydantic import (
    Field,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)

from touchdown.backend.config import NonNegative, Positive, Settings, read_settings
from touchdown.backend.core import InputError, data_folder
from touchdown.backend.geometry import outlines, regions
from touchdown.backend.geometry.outlines import Outline, Point
from touchdown.backend.geometry.surfaces import FLAT, Surface
from touchdown.backend.geometry.tower import Body


class CircleFace(Settings):
    """A round face."""

    shape: Literal["circle"]
    diameter_mm: Positive

    def outline(self) -> Outline:
        """Return the outline."""
        return outlines.circle(self.diameter_mm)


class RectangleFace(Settings):
    """A rectangle with sides along x and y."""

    shape: Literal["rectangle"]
    x_mm: Positive
    y_mm: Positive

    def outline(self) -> Outline:
        """Return the outline."""
        return outlines.rectangle(self.x_mm, self.y_mm)


class SquareFace(Settings):
    """A square with sides along x and y."""

    shape: Literal["square"]
    side_mm: Positive

    def outline(self) -> Outline:
        """Return the outline."""
        return outlines.square(self.side_mm)


class RegularFace(Settings):
    """A regular polygon, first corner on +x unless rotated."""

    shape: Literal["regular"]
    sides: Annotated[int, Field(ge=3, le=64)]
    across_corners_mm: Positive
    rotation_deg: float = 0.0

    def outline(self) -> Outline:
        """Return the outline."""
        return outlines.regular_polygon(
            self.sides, self.across_corners_mm, radians(self.rotation_deg)
        )


class PolygonFace(Settings):
    """A convex polygon round the face centre, corners counter-clockwise."""

    shape: Literal["polygon"]
    vertices_mm: tuple[tuple[float, float], ...]

    @model_validator(mode="after")
    def _is_convex(self) -> Self:
        self.outline()
        return self

    def outline(self) -> Outline:
        """Return the outline."""
        return outlines.convex_polygon(self.vertices_mm)


class RingFace(Settings):
    """A round face with a round hole in its middle."""

    shape: Literal["ring"]
    outer_mm: Positive
    inner_mm: Positive

    @model_validator(mode="after")
    def _is_ring(self) -> Self:
        self.outline()
        return self

    def outline(self) -> Outline:
        """Return the outline."""
        return regions.ring(self.outer_mm, self.inner_mm)


class RegionPart(Settings):
    """One part of a region: exterior and holes, (x, y) in mm."""

    exterior: tuple[tuple[float, float], ...]
    holes: tuple[tuple[tuple[float, float], ...], ...] = ()


class RegionFace(Settings):
    """One or several parts with holes; the face centre lies inside their convex hull."""

    shape: Literal["region"]
    parts: tuple[RegionPart, ...]

    @model_validator(mode="after")
    def _is_valid(self) -> Self:
        self.outline()
        return self

    def outline(self) -> Outline:
        """Return the outline."""
        return regions.region((part.exterior, part.holes) for part in self.parts)


Face = Annotated[
    CircleFace | RectangleFace | SquareFace | RegularFace | PolygonFace | RingFace | RegionFace,
    Field(discriminator="shape"),
]


class StepFile(Settings):
    """A step along a line through the face; the part beyond the line is higher."""

    height_mm: Annotated[float, Field(gt=0, le=1)]
    angle_deg: float = 0.0  # normal of the line, towards the higher part
    distance_mm: float = 0.0  # of the line from the centre of the face


class SurfaceFile(Settings):
    """Heights of the upper face of a bottom that is not flat."""

    tilt_deg: tuple[float, float] = (0.0, 0.0)  # rotations about x and y, together at most 3
    step: StepFile | None = None
    dome_mm: Annotated[float, Field(ge=200)] | None = None  # radius, apex at the centre

    @field_validator("tilt_deg")
    @classmethod
    def _is_small(cls, value: tuple[float, float]) -> tuple[float, float]:
        if hypot(*value) > 3.0:
            raise ValueError("a face is tilted by at most 3 degrees")
        return value

    def surface(self) -> Surface:
        """Return the surface."""
        x_deg, y_deg = self.tilt_deg
        step = self.step or StepFile.model_construct(height_mm=0.0)
        line = radians(step.angle_deg), step.distance_mm
        return Surface((radians(x_deg), radians(y_deg)), step.height_mm, line, self.dome_mm or 0.0)


class PieceFile(Settings):
    """One piece: a top that can be grasped (``grip_height_mm``), a bottom, or both.

    ``face`` is the contact face: the underside of a grasped piece, the upper surface of a bottom.
    ``opposite`` is the other end. Without it a bottom has equal ends, and nothing stands on a top.
    ``surface``: heights of the face of a bottom that is never grasped. ``com_xy_mm`` may be
    "unknown" for a top: a run must weigh it.
    """

    title: Annotated[str, Field(min_length=1, max_length=60)]
    roles: Annotated[tuple[Literal["top", "bottom"], ...], Field(min_length=1)]
    face: Face
    opposite: Face | None = None
    height_mm: Positive
    com_height_mm: Positive
    com_xy_mm: tuple[float, float] | Literal["unknown"] = (0.0, 0.0)
    mass_g: NonNegative
    fixed: Annotated[bool, Field(validate_default=True)] = False
    grip_height_mm: Annotated[Positive | None, Field(validate_default=True)] = None
    width_mm: Positive = 30.0
    nominal: bool = True
    surface: Annotated[SurfaceFile | None, Field(validate_default=True)] = None

    @field_validator("surface")
    @classmethod
    def _is_below(cls, value: SurfaceFile | None, info: ValidationInfo) -> SurfaceFile | None:
        if value is not None and "top" in info.data.get("roles", ()):
            raise ValueError("a piece with the role top has a flat face")
        return value

    @field_validator("com_height_mm")
    @classmethod
    def _com_is_within(cls, value: float, info: ValidationInfo) -> float:
        if value > info.data.get("height_mm", value):
            raise ValueError("the centre of mass lies above the piece (height_mm)")
        return value

    @field_validator("com_xy_mm", mode="wrap")
    @classmethod
    def _com_may_be_unknown(
        cls, value: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo
    ) -> Any:
        if value == "unknown" and "bottom" in info.data.get("roles", ()):
            raise ValueError("a piece with the role bottom cannot be weighed: give [x, y] in mm")
        try:
            return check(value)
        except ValidationError as error:
            raise ValueError('give [x, y] in mm, or "unknown"') from error

    @field_validator("fixed")
    @classmethod
    def _has_weight(cls, value: bool, info: ValidationInfo) -> bool:
        if not value and info.data.get("mass_g") == 0.0:
            raise ValueError("a piece that is not fixed needs a mass_g above 0")
        if value and "top" in info.data.get("roles", ()):
            raise ValueError("a fixed piece cannot have the role top")
        return value

    @field_validator("grip_height_mm")
    @classmethod
    def _can_be_gripped(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is None and "top" in info.data.get("roles", ()):
            raise ValueError("a piece with the role top needs grip_height_mm")
        if value is not None and value > info.data.get("height_mm", value):
            raise ValueError("the grip lies above the piece (height_mm)")
        return value


MESHES, DRAWINGS = (".stl", ".obj", ".ply", ".off"), (".svg", ".dxf")
PIECE_SOURCES = (*MESHES, *DRAWINGS)  # suffixes of CAD files; ``cad`` reads them
LEAST_WEIGHED_G = 100.0  # a run refuses to weigh lighter pieces
PIECE_NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")


@dataclass(frozen=True, slots=True)
class Piece:
    """One known piece.

    ``face``: contact face (underside of a grasped piece, upper surface of a bottom). ``upper`` and
    ``lower``: the ends when it stands; ``upper`` is None if nothing can stand on it. Heights are
    above the underside as it stands. ``grip_height_mm`` (face to grasp pivot) is None if it is
    never grasped; ``width_mm`` between the pads. ``fixed``: cannot topple. ``nominal``: sizes are
    not measured. ``sha256`` of the content, so that data and models know what they belong to.
    ``surface``: heights of ``upper``. An unknown ``com_xy_mm`` is NaN, with which no position is
    judged stable.
    """

    name: str
    title: str
    roles: tuple[str, ...]
    face: Outline
    upper: Outline | None
    lower: Outline
    height_mm: float
    com_height_mm: float
    com_xy_mm: Point
    mass_g: float
    grip_height_mm: float | None
    width_mm: float
    source: str
    fixed: bool = False
    nominal: bool = True
    sha256: str = ""
    surface: Surface = FLAT

    @property
    def com_known(self) -> bool:
        """True if the file gives the centre of mass, or it was weighed."""
        return isfinite(sum(self.com_xy_mm))

    def body(self, at_mm: Point = (0.0, 0.0), yaw_rad: float = 0.0) -> Body:
        """Return the piece as a body standing with its face centre at ``at_mm``.

        An unknown centre of mass is taken to be above the face centre.
        """
        return Body(
            name=self.name,
            lower=self.lower,
            upper=self.upper,
            height_mm=self.height_mm,
            mass_g=self.mass_g,
            com_height_mm=self.com_height_mm,
            com_xy_mm=self.com_xy_mm if self.com_known else (0.0, 0.0),
            at_mm=at_mm,
            yaw_rad=yaw_rad,
            fixed=self.fixed,
            surface=self.surface,
        )


@dataclass(frozen=True, slots=True)
class PieceLibrary:
    """All known pieces by name; ``broken``: errors of unusable files of the data folder."""

    pieces: Mapping[str, Piece]
    where: str
    broken: Mapping[str, InputError] = field(default_factory=dict)

    def piece(self, name: str) -> Piece:
        """Return the piece; raises ``InputError`` naming the known ones."""
        return self._known(name, "piece", f"Known pieces: {', '.join(sorted(self.pieces))}.")

    def top(self, name: str) -> Piece:
        """Return a piece that can be grasped; raises ``InputError``."""
        return self._with_role(name, "top", "cannot be grasped", self.tops)

    def bottom(self, name: str) -> Piece:
        """Return a piece that can carry another; raises ``InputError``."""
        return self._with_role(name, "bottom", "cannot carry another piece", self.bottoms)

    def _known(self, name: str, noun: str, fix: str) -> Piece:
        if name in self.pieces:
            return self.pieces[name]
        if name in self.broken:
            raise self.broken[name]
        raise InputError(f"There is no {noun} '{name}'.", f"{self.where}: {name}.toml", fix)

    def _with_role(self, name: str, role: str, lack: str, others: tuple[str, ...]) -> Piece:
        fix = f"Use one of: {', '.join(others)}."
        piece = self._known(name, "bottom piece" if role == "bottom" else "piece", fix)
        if role not in piece.roles:
            raise InputError(f"'{name}' {lack}.", piece.source, fix)
        return piece

    def add(self, piece: Piece) -> None:
        """Make a piece known that was written while the library is in use."""
        cast("dict[str, Piece]", self.pieces)[piece.name] = piece

    @property
    def tops(self) -> tuple[str, ...]:
        """Names of the pieces that can be grasped."""
        return tuple(sorted(n for n, p in list(self.pieces.items()) if "top" in p.roles))

    @property
    def bottoms(self) -> tuple[str, ...]:
        """Names of the pieces that can carry another."""
        return tuple(sorted(n for n, p in list(self.pieces.items()) if "bottom" in p.roles))


def load_pieces(folder: Path | str | None = None) -> PieceLibrary:
    """Read the shipped pieces, the operator's, and those of a folder.

    Files of the data folder never replace a shipped piece, and an unusable one of them is reported
    only when its piece is asked for.

    Parameters
    ----------
    folder : Path or str, optional
        Folder with further piece files (TOML).

    Returns
    -------
    PieceLibrary
        Pieces by name; ``tops`` can be grasped, ``bottoms`` can be touched.

    Raises
    ------
    InputError
        For the first invalid file, with file, key and reason.

    Examples
    --------
    >>> load_pieces().tops
    ('barrel', 'brick', 'mug', 'mushroom', 'pot')

    """
    own, broken = _own_pieces()
    pieces = own | dict(_shipped_pieces())
    if folder is not None:
        extra = Path(folder)
        if not extra.is_dir():
            raise InputError("There is no such folder of pieces.", str(folder), "Check the path.")
        pieces |= _read_folder(extra)
    return PieceLibrary(pieces, str(folder or "resources/objects"), broken)


def pieces_folder() -> Path:
    """Return the folder of the operator's pieces."""
    return data_folder() / "pieces"


def _own_pieces() -> tuple[dict[str, Piece], dict[str, InputError]]:
    """Read the operator's pieces; return them, and the errors of unusable files."""
    pieces: dict[str, Piece] = {}
    broken: dict[str, InputError] = {}
    for path in sorted(pieces_folder().glob("*.toml")):
        try:
            pieces[path.stem] = read_piece(path)
        except InputError as error:
            broken[path.stem] = error
    return pieces, broken


@cache
def _shipped_pieces() -> Mapping[str, Piece]:
    return _read_folder(Path(str(files("touchdown.resources"))) / "objects")


def _read_folder(folder: Path) -> dict[str, Piece]:
    return {path.stem: read_piece(path) for path in sorted(folder.glob("*.toml"))}


def read_piece(path: Path) -> Piece:
    """Read one piece file; raises ``InputError``."""
    if PIECE_NAME.fullmatch(path.stem) is None:
        what = "Names of piece files consist of small letters, digits, '-' and '_'."
        fix = "Rename the file."
        raise InputError(what, str(path), fix)
    content = read_settings(PieceFile, path)
    face = content.face.outline()
    opposite = content.opposite.outline() if content.opposite else None
    grasped = content.grip_height_mm is not None
    carries = "bottom" in content.roles
    if grasped:
        upper, lower = opposite or (face if carries else None), face
    else:
        upper, lower = face, opposite or face
    return Piece(
        name=path.stem,
        title=content.title,
        roles=content.roles,
        face=face,
        upper=upper,
        lower=lower,
        height_mm=content.height_mm,
        com_height_mm=content.com_height_mm,
        com_xy_mm=(nan, nan) if content.com_xy_mm == "unknown" else content.com_xy_mm,
        mass_g=content.mass_g,
        grip_height_mm=content.grip_height_mm,
        width_mm=content.width_mm,
        fixed=content.fixed,
        nominal=content.nominal,
        sha256=_digest(content),
        source=str(path),
        surface=content.surface.surface() if content.surface else FLAT,
    )


def _digest(content: PieceFile) -> str:
    """Return a hash independent of order, comments and title of the file."""
    facts = content.model_dump(mode="json", exclude={"title", "nominal"})
    if content.surface is None:
        del facts["surface"]  # pieces from before it keep their hash
    return sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
