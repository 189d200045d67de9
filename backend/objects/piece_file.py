"""The TOML file of one piece, typed at the edge: every bad value is named by its key."""

from __future__ import annotations

from math import radians
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from backend.config.method import NonNegative, Positive, Settings
from backend.objects import shapes
from backend.objects.shapes import Outline

Number = Annotated[float, Field(allow_inf_nan=False)]


class CircleFace(Settings):
    """A round face."""

    shape: Literal["circle"]
    diameter_mm: Positive

    def outline(self) -> Outline:
        """Return the outline."""
        return shapes.circle(self.diameter_mm)


class RectangleFace(Settings):
    """A rectangle with sides along x and y."""

    shape: Literal["rectangle"]
    x_mm: Positive
    y_mm: Positive

    def outline(self) -> Outline:
        """Return the outline."""
        return shapes.rectangle(self.x_mm, self.y_mm)


class SquareFace(Settings):
    """A square with sides along x and y."""

    shape: Literal["square"]
    side_mm: Positive

    def outline(self) -> Outline:
        """Return the outline."""
        return shapes.square(self.side_mm)


class RegularFace(Settings):
    """A regular polygon, first corner on +x unless rotated."""

    shape: Literal["regular"]
    sides: Annotated[int, Field(ge=3, le=64)]
    across_corners_mm: Positive
    rotation_deg: Number = 0.0

    def outline(self) -> Outline:
        """Return the outline."""
        return shapes.regular(self.sides, self.across_corners_mm, radians(self.rotation_deg))


class PolygonFace(Settings):
    """A convex polygon round the face centre, corners counter-clockwise."""

    shape: Literal["polygon"]
    vertices_mm: tuple[tuple[Number, Number], ...]

    @model_validator(mode="after")
    def _is_convex(self) -> Self:
        self.outline()
        return self

    def outline(self) -> Outline:
        """Return the outline."""
        return shapes.convex(self.vertices_mm)


Face = Annotated[
    CircleFace | RectangleFace | SquareFace | RegularFace | PolygonFace,
    Field(discriminator="shape"),
]


class PieceFile(Settings):
    """One piece: a top that can be grasped (``grip_height_mm``), a bottom, or both.

    ``face`` is the contact face: the underside of a grasped piece, the upper surface of a bottom.
    ``opposite`` is the other end; a bottom without it has equal ends, a top without it carries
    nothing.
    """

    title: Annotated[str, Field(min_length=1, max_length=60)]
    roles: Annotated[tuple[Literal["top", "bottom"], ...], Field(min_length=1)]
    face: Face
    opposite: Face | None = None
    height_mm: Positive
    com_height_mm: Positive
    com_xy_mm: tuple[Number, Number] = (0.0, 0.0)
    mass_g: NonNegative
    fixed: Annotated[bool, Field(validate_default=True)] = False
    grip_height_mm: Annotated[Positive | None, Field(validate_default=True)] = None
    width_mm: Positive = 30.0
    nominal: bool = True

    @field_validator("com_height_mm")
    @classmethod
    def _com_is_within(cls, value: float, info: ValidationInfo) -> float:
        if value > info.data.get("height_mm", value):
            raise ValueError("the centre of mass lies above the piece (height_mm)")
        return value

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
