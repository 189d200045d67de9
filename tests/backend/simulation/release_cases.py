"""Random stacks, and the verdicts of the exact analysis and of MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from touchdown.backend.config import SurfaceSettings
from touchdown.backend.geometry import (
    Body,
    Outline,
    Tower,
    TowerVerdict,
    judge_tower,
    outlines,
    piece_on_surface,
    regions,
)
from touchdown.backend.simulation.conditions import draw_surface
from touchdown.backend.simulation.release_mujoco import contradicts_analysis, simulate_release

# number of bodies, whether the lowest is fixed, number of cases
SETS = {"fixed pair": (2, True, 120), "free pair": (2, False, 90), "three bodies": (3, False, 90)}
SHAPES = {
    "ring": regions.ring(24.0, 14.0),
    "crescent": regions.crescent(24.0, 18.0, 7.0),
    "L": regions.ell(20.0, 16.0, 6.0),
    "T": regions.tee(20.0, 18.0, 6.0),
    "U": regions.channel(20.0, 16.0, 5.0),
    "star": regions.star(5, 26.0, 12.0),
    "feet": regions.feet([(9.0, 0.0), (-4.5, 7.8), (-4.5, -7.8)], 6.0),
}
PLAIN = (
    outlines.circle(20.0), outlines.rectangle(12.0, 24.0), outlines.regular_polygon(3, 24.0)
)  # fmt: skip
CLEAR_MM = (
    0.5  # beyond this margin 0.7 s show the outcome; nearer to the edge a fall may take longer
)


@dataclass(frozen=True)
class Opinions:
    """Verdict of the exact analysis on one stack, and the fall in MuJoCo."""

    verdict: TowerVerdict
    fallen: bool

    @property
    def unlike(self) -> bool:
        """True if the two disagree."""
        return self.fallen == self.verdict.stands

    @property
    def beyond(self) -> bool:
        """True if they disagree beyond the error of MuJoCo."""
        return contradicts_analysis(self.verdict, self.fallen)


def ask_both(name: str, share: float = 1.0) -> Iterator[Opinions]:
    """Yield the opinions on the stacks of one of ``SETS``, or on the first ``share`` of them."""
    count, fixed, cases = SETS[name]
    rng = np.random.default_rng(20)
    for _ in range(round(share * cases)):
        tower = stack(rng, count, fixed=fixed, yaw=not fixed)
        verdict = judge_tower(tower)
        near = abs(verdict.margin_mm) <= CLEAR_MM
        yield Opinions(verdict, simulate_release(tower, seconds=1.5 if near else 0.7)[0])


def ask_about_shape(name: str, cases: int) -> Iterator[Opinions]:
    """Yield the opinions on one of ``SHAPES`` above or below other faces, far from the threshold.

    About half of the places are over the edge of the contact.
    """
    rng = np.random.default_rng([21, *name.encode()])
    others = [*SHAPES.values(), outlines.circle(20.0), outlines.regular_polygon(6, 20.0)]
    found = 0
    while found < cases:
        faces = [SHAPES[name], others[int(rng.integers(len(others)))]]
        lower, upper = faces if rng.random() < 0.5 else faces[::-1]
        height, (x, y) = float(rng.uniform(15.0, 50.0)), rng.uniform(-11.0, 11.0, 2).tolist()
        tower = Tower(
            (
                Body("base", lower, lower, 30.0, 0.0, 15.0, fixed=True),
                Body(
                    "lid", upper, upper, height, float(rng.uniform(20.0, 60.0)), height / 2,
                    com_xy_mm=(float(rng.uniform(-1.5, 1.5)), float(rng.uniform(-1.5, 1.5))),
                    at_mm=(x, y), yaw_rad=float(rng.uniform(-math.pi, math.pi)),
                ),
            )
        )  # fmt: skip
        verdict = judge_tower(tower)
        if abs(verdict.margin_mm) > CLEAR_MM:
            found += 1
            yield Opinions(verdict, simulate_release(tower, seconds=0.7)[0])


SURFACES = ("tilted", "stepped", "domed")


def ask_about_surface(kind: str, cases: int) -> Iterator[Opinions]:
    """Yield the opinions on all outlines over faces that are tilted, stepped or domed.

    Each case has another outline below. Every second place is unstable.
    """
    rng = np.random.default_rng([21, *kind.encode()])
    settings = SurfaceSettings.model_validate({f"{kind}_share": 1.0})
    every = [*SHAPES.values(), *PLAIN]
    found = 0
    while found < cases:
        lower, upper = every[found % len(every)], every[int(rng.integers(len(every)))]
        surface = draw_surface(settings, max(lower.half_extents_mm), rng)
        base = Body("base", lower, lower, 30.0, 0.0, 15.0, fixed=True, surface=surface)
        height, (x, y) = float(rng.uniform(15.0, 50.0)), rng.uniform(-11.0, 11.0, 2).tolist()
        lid = Body(
            "lid", upper, upper, height, float(rng.uniform(20.0, 60.0)), height / 2,
            com_xy_mm=(float(rng.uniform(-1.5, 1.5)), float(rng.uniform(-1.5, 1.5))),
            at_mm=(x, y), yaw_rad=float(rng.uniform(-math.pi, math.pi)),
        )  # fmt: skip
        tower = Tower((base, lid))
        if len(piece_on_surface(tower).points_mm) and judge_tower(tower, sign_only=True).stands == (
            found % 2 == 0
        ):
            found += 1
            yield Opinions(judge_tower(tower), simulate_release(tower, seconds=1.5)[0])


def outline(rng: np.random.Generator) -> Outline:
    """Draw a circle, rectangle or hexagon of 7.5 to 15 mm radius."""
    kind = rng.integers(3)
    r = float(rng.uniform(7.5, 15.0))
    if kind == 0:
        return outlines.circle(2 * r)
    if kind == 1:
        return outlines.rectangle(2 * r, 2 * float(rng.uniform(7.5, 15.0)))
    return outlines.regular_polygon(6, 2 * r)


def body(rng: np.random.Generator, name: str, at_mm: tuple[float, float], *, yaw: bool) -> Body:
    """Draw a free body of 15 to 70 mm height and 20 to 60 g."""
    face = outline(rng)
    height = float(rng.uniform(15.0, 70.0))
    return Body(
        name,
        face,
        face,
        height,
        float(rng.uniform(20.0, 60.0)),
        height / 2,
        at_mm=at_mm,
        yaw_rad=float(rng.uniform(-math.pi, math.pi)) if yaw else 0.0,
    )


def stack(rng: np.random.Generator, count: int, *, fixed: bool, yaw: bool = False) -> Tower:
    """Draw a stack whose bodies lie 2 to 14 mm off the one below, so that about half fall."""
    at = (0.0, 0.0)
    bodies: list[Body] = []
    for index in range(count):
        bodies.append(body(rng, f"b{index}", at, yaw=yaw))
        reach, angle = rng.uniform(2.0, 14.0), rng.uniform(0.0, 2 * math.pi)
        at = (at[0] + reach * math.cos(angle), at[1] + reach * math.sin(angle))
    if fixed:
        first = bodies[0]
        face = first.lower
        bodies[0] = Body(
            "base", face, face, first.height_mm, 0.0, 1.0, yaw_rad=first.yaw_rad, fixed=True
        )
    return Tower(tuple(bodies))
