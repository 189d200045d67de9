"""Scale, finger and mirroring with the simulated gel, exchanged and mirrored on purpose."""

from __future__ import annotations

import hashlib
import json
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.backend.annotations.test_packs_in_datasets import no_file_above
from touchdown.backend.calibration.applied import UNCALIBRATED, calibrated_positions
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
from touchdown.backend.calibration.records import CalibrationStore, DeviceName, read_record
from touchdown.backend.calibration.result import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    MIRROR_CODES,
    CalibrationEstimate,
    CalibrationName,
    Quantity,
    format_value,
)
from touchdown.backend.config import BenchIdentity
from touchdown.backend.core import (
    MARKERS,
    CalibrationMeasured,
    InputError,
    PhaseEntered,
    RefusedError,
)
from touchdown.backend.runs.calibrate import MOST_PUSHES, next_side
from touchdown.backend.runs.calibrations import payload_wrench
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


def test_the_scale_is_that_of_the_gel():
    found = estimate_cameras(pushes(), PITCH_MM)
    for finger, scale in zip(("left", "right"), SCALE, strict=True):
        for axis in "uv":
            assert found.value(f"{finger}_{axis}_mm_px") == pytest.approx(scale, rel=2e-3)
    assert found.acceptable


def test_the_scale_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(5)
    scores = []
    for _ in range(400):
        noisy = GEL.rest_px[0] + DOT_SIGMA_PX * rng.standard_normal((63, 2))
        for axis in fit_lattice(noisy).scale_mm_px(PITCH_MM):
            scores.append((axis.value - SCALE[0]) / axis.sigma)
    assert abs((np.abs(scores) < 1.0).mean() - 0.683) < 0.066


def test_a_gel_with_another_pitch_or_a_lost_dot_is_not_accepted():
    bent = [SidePress(p.side, p.rest_px + 12.0 * (np.arange(63)[:, None] % 2), p.moved_px)
            for p in pushes()]  # fmt: skip
    assert not estimate_cameras(bent, PITCH_MM).acceptable
    with pytest.raises(RefusedError, match="MARKERS"):
        fit_lattice(np.zeros((62, 2)))


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("left", ["none", "x", "y", "both"])
@pytest.mark.parametrize("right", ["none", "x", "y", "both"])
def test_every_way_that_two_cameras_can_sit_is_found(swap, left, right):
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


def test_motion_of_a_picture_is_told_by_shift_and_turn():
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


def test_gels_that_creep_by_as_much_as_the_fingers_differ_are_pressed_until_it_is_sure():
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


def test_presses_that_tell_nothing_are_refused_by_name():
    full = pushes()
    weak = [SidePress(p.side, p.rest_px, 0.01 * p.moved_px) for p in full]
    even = [SidePress(p.side, p.rest_px, full[0].moved_px) for p in full]
    for given, reason in ((full[:3], "PUSHES"), (weak, "WEAK-PUSH"), (even, "EVEN-PUSH")):
        with pytest.raises(RefusedError) as refused:
            find_arrangement(given)
        assert refused.value.reason == reason


NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
DEVICES = {
    "force_torque": DeviceName(maker="W", model="Six", serial="F1"),
    "gripper": DeviceName(maker="G", model="Jaws", serial="G1"),
    "arm": DeviceName(maker="A", model="Arm", serial="A1"),
}
ESTIMATE = CalibrationEstimate(
    (
        Quantity("mass_kg", 1.5, 0.01, "kg"),
        Quantity("com_x_mm", 0.0, 0.1, "mm"),
        Quantity("com_y_mm", 0.0, 0.1, "mm"),
    ),
    np.eye(3),
    np.array([0.1]),
    0.1,
    0.3,
    "N",
    note="Level.",
)

FOUND = ESTIMATE.to_event(0.0, "payload")


def of_kind(what: CalibrationName) -> CalibrationMeasured:
    """Return a result with all that is read of this kind when it is applied."""
    names = CALIBRATION_KINDS[what].values
    count = len(names)
    about = "pot on short" if what == "board" else ""
    return replace(
        FOUND, what=what, names=names, values=count * (0.06,), sigmas=count * (0.01,),
        units=count * ("mm",), about=about,
    )  # fmt: skip


@pytest.fixture
def store(tmp_path) -> CalibrationStore:
    return CalibrationStore(tmp_path / "calibrations", "hardware", "--bench lab.toml")


def test_the_file_tells_everything_and_names_itself(store):
    path = store.accept(FOUND, DEVICES, "Ada", NOW)
    content = json.loads(path.read_text())
    told = content.pop("sha256")
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    assert told == hashlib.sha256(canonical.encode()).hexdigest()
    assert content["values"]["mass_kg"] == {"value": 1.5, "sigma": 0.01, "unit": "kg"}
    assert set(content["values"]) == {"mass_kg", "com_x_mm", "com_y_mm"}
    assert (content["residual"], content["limit"], content["unit"]) == (0.1, 0.3, "N")
    assert content["date"] == "2026-03-01T12:00:00Z"
    assert (content["expires_days"], content["person"], content["mode"]) == (90, "Ada", "hardware")
    assert set(content["devices"]) == {"force_torque", "gripper"}
    assert read_record(path).sha256 == told


def test_what_is_not_acceptable_is_not_written(store):
    for estimate, reason in (
        (replace(FOUND, residual=0.31), "RESIDUAL"),
        (replace(FOUND, residual=float("nan")), "RESIDUAL"),
        (replace(FOUND, obstacle="Turn it."), "OBSTACLE"),
    ):
        with pytest.raises(RefusedError) as refused:
            store.accept(estimate, DEVICES, now=NOW)
        assert refused.value.reason == reason
    assert not store.folder.exists()


def test_the_newest_holds_until_it_expires(store):
    assert store.status("payload", DEVICES, NOW).condition == "missing"
    store.accept(FOUND, DEVICES, now=NOW)
    newer = store.accept(replace(FOUND, residual=0.2), DEVICES, now=NOW + timedelta(1))
    standing = store.status("payload", DEVICES, NOW + timedelta(90.9))
    assert standing.condition == "valid"
    assert standing.record == read_record(newer)
    late = store.status("payload", DEVICES, NOW + timedelta(94))
    assert (late.condition, late.why) == ("expired", "expired 3 days ago")
    assert late.fix == "Run 'touchdown calibrate payload --bench lab.toml --accept'."
    window = CalibrationStore(store.folder, "hardware", where=None)
    late = window.status("payload", DEVICES, NOW + timedelta(94))
    assert late.fix == "Measure Payload in Calibrate (Ctrl+Shift+K)."
    assert window.step("day") == "measure Daily check in Calibrate (Ctrl+Shift+K)"


def test_a_calibration_belongs_to_its_devices_and_to_its_kind_of_bench(store):
    store.accept(FOUND, DEVICES, now=NOW)
    other = {**DEVICES, "force_torque": DeviceName(maker="W", model="Six", serial="F2")}
    assert store.status("payload", other, NOW).condition == "other device"
    assert "force_torque F1" in store.status("payload", other, NOW).why
    # The arm is no part of a payload, and devices that are not there yet are not compared.
    assert store.status("payload", {"arm": other["force_torque"]}, NOW).condition == "valid"
    elsewhere = CalibrationStore(store.folder, "simulated")
    assert elsewhere.status("payload", DEVICES, NOW).condition == "missing"


def test_a_device_that_tells_no_number_goes_by_the_name_of_its_port(store):
    """The links of an emulated bench lie in another folder each time it is started."""

    def by_port(port: str) -> dict[str, DeviceName]:
        return {**DEVICES, "force_torque": DeviceName(maker="W", model="Six", serial=port)}

    store.accept(FOUND, by_port("links-1/force_torque"), now=NOW)
    for port, condition in (
        ("links-2/force_torque", "valid"), ("links-1/other", "other device"),
    ):  # fmt: skip
        assert store.status("payload", by_port(port), NOW).condition == condition


@pytest.mark.promise("D13")
def test_a_changed_or_broken_file_is_said_and_not_used(store):
    path = store.accept(FOUND, DEVICES, now=NOW)
    good = path.read_text()
    for bad, said in (
        (good.replace('"value": 1.5', '"value": 1.4'), "was changed"),
        (good.replace('"version": 1', '"version": 2'), "'version'"),
        (good[:40], "not a calibration"),
        ("[]", "not a calibration"),
    ):
        path.write_text(bad)
        with pytest.raises(InputError, match=said):
            read_record(path)
        assert store.status("payload", DEVICES, NOW).condition == "damaged"


def rewritten(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the content of a calibration, and its hash with it."""
    content = json.loads(path.read_text())
    content.pop("sha256")
    change(content)
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    path.write_text(
        json.dumps({**content, "sha256": hashlib.sha256(canonical.encode()).hexdigest()})
    )


@pytest.mark.promise("D13")
@pytest.mark.parametrize("what", CALIBRATION_NAMES)
def test_what_cannot_be_applied_is_damaged_though_its_hash_fits(store, what):
    path = store.accept(of_kind(what), DEVICES, now=NOW)
    whole = path.read_text()
    changes: list[Callable[[dict[str, Any]], object]] = [
        *(lambda c, name=name: c["values"].pop(name) for name in CALIBRATION_KINDS[what].values),
        lambda c: c.update(about="pot"),
        lambda c: c.update(about="a on b on c"),
        lambda c: c.update(gels={next(iter(c["devices"]), "arm"): [1.0] * 125}),
        lambda c: c.update(gels={"nobody": [1.0] * 126}),
        *(
            lambda c, x=x: c.update(gels={next(iter(c["devices"]), "arm"): [x] + [1.0] * 125})
            for x in (float("nan"), float("inf"))
        ),
        lambda c: c["values"].update(left_mirror={"value": 4.0, "sigma": 0.0, "unit": ""}),
        lambda c: c["values"].update(left_mirror={"value": 0.5, "sigma": 0.0, "unit": ""}),
    ]
    if what == "camera":
        changes.append(lambda c: c["values"]["left_u_mm_px"].update(value=0.0))
    for change in changes:
        path.write_text(whole)
        rewritten(path, change)
        standing = store.status(what, DEVICES, NOW)
        assert standing.condition == "damaged", change
        assert path.name in standing.why
    for text in ("[" * 100_000, whole + " " * 1_000_000, whole[:-30], ""):
        path.write_text(text)
        assert store.status(what, DEVICES, NOW).condition == "damaged"
    used = store.in_use(DEVICES, required=False, now=NOW)
    assert calibrated_positions(used) == UNCALIBRATED
    assert payload_wrench(store, {}) is None
    with pytest.raises(RefusedError, match=r"CALIBRATION-(DAMAGED|MISSING)"):
        store.in_use(DEVICES, required=True, now=NOW)


def test_a_disk_that_takes_no_more_keeps_the_calibration_before(store):
    before = store.accept(of_kind("camera"), DEVICES, now=NOW).read_bytes()
    with no_file_above(100), pytest.raises(InputError):
        store.accept(of_kind("camera"), DEVICES, now=NOW + timedelta(hours=1))
    standing = store.status("camera", DEVICES, NOW)
    assert standing.condition == "valid"
    kept = [path for path in store.folder.rglob("*") if path.is_file()]
    assert [path.read_bytes() for path in kept] == [before]


def test_a_bench_that_needs_them_is_refused_by_name_with_the_fix(store):
    def refusal(now: datetime, devices=DEVICES) -> RefusedError:
        with pytest.raises(RefusedError) as refused:
            store.in_use(devices, required=True, now=now)
        return refused.value

    assert refusal(NOW).reason == "CALIBRATION-MISSING"
    assert "touchdown calibrate payload" in refusal(NOW).detail
    assert store.in_use(DEVICES, required=False, now=NOW) == {}
    for what in ("payload", "board", "tool", "wrist", "camera"):
        store.accept(of_kind(what), DEVICES, now=NOW)
    used = store.in_use(DEVICES, required=True, now=NOW)
    assert len({record.sha256 for record in used.values()}) == 5
    error = refusal(NOW + timedelta(2))
    assert error.reason == "CALIBRATION-EXPIRED"
    assert error.detail.startswith("Board: expired 24 h ago")
    assert set(store.in_use(DEVICES, required=False, now=NOW + timedelta(2))) == set(used) - {
        "board"
    }


@pytest.mark.parametrize(
    ("name", "value", "sigma", "unit", "words"),
    [
        ("exchanged", 0.0, 0.0, "", "no"),
        ("exchanged", 1.0, 0.0, "", "yes"),
        ("left_mirror", 0.0, 0.0, "", "no"),
        ("right_mirror", 3.0, 0.0, "", "in x and y"),
        ("left_mirror", 2.0, 0.0, "", "in y"),
        ("x_mm", -0.1234, 0.05, "mm", "\N{MINUS SIGN}0.123 \N{PLUS-MINUS SIGN} 0.050 mm"),
        ("yaw_rad", 0.01, 0.001, "rad", "0.573° \N{PLUS-MINUS SIGN} 0.057°"),
    ],
)
def test_values_have_words_digits_and_units(name, value, sigma, unit, words):
    assert format_value(name, value, sigma, unit) == words


GOOD_DAY = {
    **{f"{side}_markers": float(MARKERS) for side in ("left", "right")},
    "left_stiffness_px_n": 1.1, "right_stiffness_px_n": 1.1,
    "wrist_noise_n": 0.1, "wrist_drift_n_min": 0.01,
}  # fmt: skip
BENCH = BenchIdentity("Lab", "abc", daily_check=True)


def checked(store, day, bench=BENCH, **changes: float) -> CalibrationMeasured:
    """Make the check of a day; return its event."""
    values = GOOD_DAY | changes
    estimate = CalibrationEstimate(
        tuple(Quantity(n, v, 0.0, "") for n, v in values.items()), np.eye(6), np.zeros(0), 0.0,
        1.0, "of the limits",
    )  # fmt: skip
    event = estimate.to_event(0.0, "day")
    return store.day_checks(bench).judge(event, NOW + timedelta(days=day))


def test_a_daily_check_that_is_missing_or_out_of_limits_withholds_releases_in_words(store):
    def why(day):
        return store.day_checks(BENCH).obstacle(NOW + timedelta(days=day))

    fix = "each release is asked. Run 'touchdown check-day --bench lab.toml'."
    assert why(0) == f"There is no daily check of today: {fix}"
    assert store.day_checks(replace(BENCH, daily_check=False)).obstacle() == ""
    assert checked(store, 0).acceptable
    assert (why(0), why(1)[:32]) == ("", "There is no daily check of today")
    found = checked(store, 1, left_markers=59.0, wrist_noise_n=0.4)
    assert not found.acceptable
    assert "Number of markers, left finger: 59, below 60. Clean the gel" in found.obstacle
    assert "Noise at rest, wrist sensor: 0.4, above 0.2 N. Check its cable" in found.obstacle
    assert why(1) == (
        f"The daily check of 2026-03-02 is out of limits (number of markers, left finger; "
        f"noise at rest, wrist sensor): {fix}"
    )
    bad = store.day_checks(BENCH).read()[0][-1]
    names = [name for name, _, _ in bad.rows()]
    cross = "\N{MULTIPLICATION X} "
    assert sorted(names[:2]) == [
        f"{cross}Noise at rest, wrist sensor", f"{cross}Number of markers, left finger"
    ]  # fmt: skip
    assert not any(name.startswith(cross) for name in names[2:])
    assert len(names) == len(bad.limits) > 2
    # The last check of a day counts; another bench has checks of its own.
    assert checked(store, 1).acceptable
    checked(store, 1, replace(BENCH, sha256="other"), left_markers=1.0)
    assert why(1) == ""
    assert [check.day for check in store.day_checks(BENCH).read()[0]] == [
        "2026-03-01",
        "2026-03-02",
    ]


def test_the_markers_of_a_gel_are_compared_with_its_first_check(store, tmp_path):
    assert checked(store, 0, left_markers=61.0).residuals[0] == pytest.approx(1 / 3)
    assert checked(store, 1, left_markers=58.0, right_markers=62.0).acceptable
    assert "left finger: 57, below 58." in checked(store, 2, left_markers=57.0).obstacle
    other = replace(BENCH, sha256="other")
    assert "left finger: 56, below 57." in checked(store, 3, other, left_markers=56.0).obstacle
    for day in range(4, 10):
        assert checked(store, day, left_markers=58.0).acceptable
    # By serial number after other settings of the bench, and on the other finger.
    named = CalibrationStore(tmp_path, "hardware", gels=("A", "B"))
    assert checked(named, 0).acceptable
    named = CalibrationStore(tmp_path, "hardware", gels=("C", "A"))
    found = checked(named, 1, other, left_markers=59.0, right_markers=59.0)
    assert found.obstacle.startswith("Number of markers, right finger: 59, below 60. Clean")
    assert "left" not in found.obstacle


def test_a_history_tightens_the_limits_and_what_is_out_of_them_is_no_part_of_it(store):
    for day in range(5):
        assert checked(store, day, left_stiffness_px_n=1.1 + 0.01 * day).acceptable
    assert "Motion of the markers, left finger: 1.6" in (
        checked(store, 5, left_stiffness_px_n=1.6).obstacle
    )
    for day in range(6, 20):
        assert not checked(store, day, left_stiffness_px_n=1.6).acceptable
    assert checked(store, 20, left_stiffness_px_n=1.15).acceptable


@pytest.mark.parametrize("damage", [b"{\n", b'{"version": 1', b"\xff\xfe\n", b'{"version": 2}\n'])
def test_a_damaged_line_is_skipped_and_as_the_last_one_withholds_releases(store, damage):
    checked(store, 0)
    (path,) = store.folder.iterdir()
    path.write_bytes(path.read_bytes() + damage)
    checks = store.day_checks(BENCH)
    assert len(checks.read()[0]) == 1
    assert checks.obstacle(NOW).startswith("The record of the last daily check is damaged: each")
    checked(store, 0)
    assert store.day_checks(BENCH).obstacle(NOW) == ""
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match="The daily checks cannot be read"):
        checks.obstacle()


def pressed(folder, left: str, presses: int):
    """Press with these gels; return the ledger."""
    ledger = CalibrationStore(folder, "hardware", gels=(left, "R-1")).gels
    for _ in range(presses):
        ledger.take(PhaseEntered(0.0, "press", 1))
        ledger.take(PhaseEntered(0.0, "approach", 1))
    return ledger


def test_presses_are_counted_by_serial_number_and_survive_a_torn_line(tmp_path):
    assert pressed(tmp_path, "", 2).texts().keys() == {"tactile_right"}
    left, right = pressed(tmp_path, "A", 3).lives()
    assert (left.presses, right.presses, left.before) == (3, 5, "")
    path = tmp_path / "gel-left-hardware.txt"
    # A line torn by a power failure is skipped; the next press begins a new one.
    path.write_bytes(path.read_bytes() + b"\n2026-01-01T00:00:00+00:00 A")
    left, _ = pressed(tmp_path, "A", 1).lives()
    assert (left.presses, left.before) == (4, "")
    assert left.text == f"Left gel A: 4 presses since {datetime.now():%Y-%m-%d}"
    left, _ = pressed(tmp_path, "B", 0).lives()
    assert (left.presses, left.before) == (0, "A")
    left, _ = pressed(tmp_path, "A", 1).lives()
    assert (left.presses, left.before) == (5, "")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_killed_program_loses_no_press(tmp_path):
    reader, writer = os.pipe()
    child = os.fork()
    while child == 0:
        pressed(tmp_path, "A", 1)
        os.write(writer, b".")
    os.close(writer)
    told = os.read(reader, 1)
    while len(told) < 20:
        told += os.read(reader, 1)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    while more := os.read(reader, 4096):
        told += more
    os.close(reader)
    left, right = pressed(tmp_path, "A", 0).lives()
    assert right.presses in (len(told), len(told) + 1)
    assert left.presses in (right.presses, right.presses + 1)


def test_a_replaced_gel_ends_the_camera_calibration_until_it_is_made_again(tmp_path):
    store = CalibrationStore(tmp_path, "hardware", gels=("B", "R-1"))
    store.accept(of_kind("camera"), {}, now=NOW)
    assert store.status("camera", {}, NOW).condition == "valid"
    pressed(tmp_path, "A", 1)
    pressed(tmp_path, "B", 1)
    standing = store.status("camera", {}, NOW)
    today = f"{datetime.now():%Y-%m-%d}"
    assert standing.condition == "gel replaced"
    assert standing.why == f"the left gel was replaced on {today} (A by B)"
    assert "camera" not in store.in_use({}, required=False)
    store.accept(of_kind("camera"), {}, now=datetime.now(UTC) + timedelta(seconds=2))
    assert store.status("camera", {}).condition == "valid"
