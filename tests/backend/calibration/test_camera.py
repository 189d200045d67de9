"""Scale, finger and mirroring with the simulated gel, exchanged and mirrored on purpose."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.calibration.cameras import (
    DOT_SIGMA_PX,
    SIDES,
    Side,
    SidePress,
    estimate_cameras,
    find_arrangement,
    fingers_distinguishable,
    fit_lattice,
    image_motion,
)
from touchdown.backend.calibration.result import MIRROR_CODES
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.runs.calibrate import MOST_PUSHES, next_side
from touchdown.backend.simulation.marker_fields import build_gel

SCALE, PITCH_MM = (0.058, 0.062), 1.9
GEL = build_gel(SCALE, PITCH_MM)
SIZE_PX = np.array([320.0, 240.0])


def pushes(noise_px: float = 0.05, seed: int = 0) -> list[SidePress]:
    """Return the fields of a press of 0.9 mm that leans the piece towards each side."""
    rng = np.random.default_rng(seed)
    made = []
    for side in SIDES:
        sign = 1.0 if side[0] == "+" else -1.0
        strain = np.zeros((2, 3))
        strain[:, 1] = 0.9
        if side[1] == "x":
            # Contact on the other side of the face: its moment about y is positive for +x.
            strain[:, 2] = 0.05 * sign
        else:
            # Displaced to +y the contact is nearer to the right finger.
            strain[:, 1] += 0.06 * sign * np.array([-1.0, 1.0])
        moved = GEL.displacement_px(strain, np.array([10.0, 10.0]), np.array(10.0))
        moved = moved + noise_px * rng.standard_normal(moved.shape)
        rest = GEL.rest_px + DOT_SIGMA_PX * rng.standard_normal(GEL.rest_px.shape)
        made.append(SidePress(side, rest, moved))
    return made


def mirrored(push: SidePress, camera: int, axis: int) -> SidePress:
    """Return the fields of a camera with a mirrored picture; dots renumbered."""
    rest, moved = push.rest_px.copy(), push.moved_px.copy()
    order = np.arange(63).reshape(7, 9)
    order = (order[:, ::-1] if axis == 0 else order[::-1]).ravel()
    rest[camera], moved[camera] = rest[camera][order], moved[camera][order]
    rest[camera, :, axis] = SIZE_PX[axis] - rest[camera, :, axis]
    moved[camera, :, axis] *= -1.0
    return SidePress(push.side, rest, moved)


def exchanged(push: SidePress) -> SidePress:
    return SidePress(push.side, push.rest_px[::-1].copy(), push.moved_px[::-1].copy())


def test_the_scale_is_that_of_the_gel() -> None:
    found = estimate_cameras(pushes(), PITCH_MM)
    for finger, scale in zip(("left", "right"), SCALE, strict=True):
        for axis in "uv":
            assert found.value(f"{finger}_{axis}_mm_px") == pytest.approx(scale, rel=2e-3)
    assert found.acceptable


def test_the_scale_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    scores = []
    for _ in range(400):
        noisy = GEL.rest_px[0] + DOT_SIGMA_PX * rng.standard_normal((63, 2))
        for axis in fit_lattice(noisy).scale_mm_px(PITCH_MM):
            scores.append((axis.value - SCALE[0]) / axis.sigma)
    assert abs((np.abs(scores) < 1.0).mean() - 0.683) < 0.066


def test_a_gel_with_another_pitch_or_a_lost_dot_is_not_accepted() -> None:
    bent = [SidePress(p.side, p.rest_px + 12.0 * (np.arange(63)[:, None] % 2), p.moved_px)
            for p in pushes()]  # fmt: skip
    assert not estimate_cameras(bent, PITCH_MM).acceptable
    with pytest.raises(RefusedError, match="MARKERS"):
        fit_lattice(np.zeros((62, 2)))


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("left", ["none", "x", "y", "both"])
@pytest.mark.parametrize("right", ["none", "x", "y", "both"])
def test_every_way_that_two_cameras_can_sit_is_found(swap, left, right) -> None:
    seen = pushes()
    for camera, mirror in enumerate((left, right)):
        for axis, names in ((0, ("x", "both")), (1, ("y", "both"))):
            if mirror in names:
                seen = [mirrored(push, camera, axis) for push in seen]
    if swap:
        seen = [exchanged(push) for push in seen]
    found = find_arrangement(seen)
    assert found.exchanged == swap
    assert found.mirror == {"left": left, "right": right}
    estimate = estimate_cameras(seen, PITCH_MM)
    assert estimate.acceptable
    assert estimate.value("exchanged") == swap
    told = [MIRROR_CODES[int(estimate.value(f"{finger}_mirror"))] for finger in ("left", "right")]
    assert told == [left, right]
    wrong = swap or (left, right) != ("none", "none")
    assert ("corrected" in estimate.note) == wrong


def test_motion_of_a_picture_is_told_by_shift_and_turn() -> None:
    rest, angle = GEL.rest_px[0], 0.03
    arm = rest - rest.mean(axis=0)
    moved = arm @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) - arm
    shift, turn = image_motion(rest, moved + np.array([1.5, -2.0]))
    np.testing.assert_allclose(shift, [1.5, -2.0])
    assert turn == pytest.approx(np.sin(angle))


def crept(rng: np.random.Generator, side: Side, lead_px: float, creep_px: float) -> SidePress:
    """Return a press that moves the nearer finger more by half of ``lead_px``; both gels creep."""
    near = {"+y": np.array([-0.25, 0.25]), "-y": np.array([0.25, -0.25])}.get(side, np.zeros(2))
    rest = GEL.rest_px[0]
    arm = rest - rest.mean(axis=0)
    turn = {"+x": 0.003, "-x": -0.003}.get(side, 0.0) * np.array([1.0, -1.0])
    moved = np.zeros((2, 63, 2))
    for k in range(2):
        moved[k] = turn[k] * np.column_stack([-arm[:, 1], arm[:, 0]])
        moved[k] += np.clip(creep_px * rng.standard_normal(2), -1.0, 1.0)
        moved[k, :, 1] -= 7.0 + lead_px * near[k]
    return SidePress(side, np.stack([rest, rest]), moved)


def test_gels_that_creep_by_as_much_as_the_fingers_differ_are_pressed_until_it_is_sure() -> None:
    rng = np.random.default_rng(8)
    presses, wrong, even = [], 0, 0
    for _ in range(40):
        pushed: list[SidePress] = []
        while (side := next_side(pushed)) is not None:
            pushed.append(crept(rng, side, lead_px=1.5, creep_px=0.6))
        presses.append(len(pushed))
        if fingers_distinguishable(pushed):
            wrong += find_arrangement(pushed).exchanged
        else:
            even += 1
    # One press to each side alone would take the fingers for each other in 4 of 100.
    assert wrong == 0
    assert even <= 4
    assert min(presses) == 8
    assert np.mean(presses) < 14
    calm = [crept(rng, side, 1.5, 0.05) for side in (*SIDES, "+y", "-y", "+y", "-y")]
    assert next_side(calm) is None
    # Fingers that do not differ are never told apart, however long.
    alike: list[SidePress] = []
    while (side := next_side(alike)) is not None:
        alike.append(crept(rng, side, 0.0, 0.3))
    assert len(alike) == MOST_PUSHES
    with pytest.raises(RefusedError, match="EVEN-PUSH"):
        find_arrangement(alike)


def test_presses_that_tell_nothing_are_refused_by_name() -> None:
    full = pushes()
    weak = [SidePress(p.side, p.rest_px, 0.01 * p.moved_px) for p in full]
    even = [SidePress(p.side, p.rest_px, full[0].moved_px) for p in full]
    for given, reason in ((full[:3], "PUSHES"), (weak, "WEAK-PUSH"), (even, "EVEN-PUSH")):
        with pytest.raises(RefusedError) as refused:
            find_arrangement(given)
        assert refused.value.reason == reason
