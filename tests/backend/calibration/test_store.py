"""Calibration files: kind, devices, validity and hash."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.backend.calibration.applied import UNCALIBRATED, calibrated_positions
from touchdown.backend.calibration.records import CalibrationStore, DeviceName, read_record
from touchdown.backend.calibration.result import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    CalibrationEstimate,
    CalibrationName,
    Quantity,
)
from touchdown.backend.core.events import CalibrationMeasured
from touchdown.backend.core.faults import InputError, RefusedError
from touchdown.backend.runs.calibrations import payload_wrench

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


def test_the_file_tells_everything_and_names_itself(store) -> None:
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


def test_what_is_not_acceptable_is_not_written(store) -> None:
    for estimate, reason in (
        (replace(FOUND, residual=0.31), "RESIDUAL"),
        (replace(FOUND, residual=float("nan")), "RESIDUAL"),
        (replace(FOUND, obstacle="Turn it."), "OBSTACLE"),
    ):
        with pytest.raises(RefusedError) as refused:
            store.accept(estimate, DEVICES, now=NOW)
        assert refused.value.reason == reason
    assert not store.folder.exists()


def test_the_newest_holds_until_it_expires(store) -> None:
    assert store.status("payload", DEVICES, NOW).condition == "missing"
    store.accept(FOUND, DEVICES, now=NOW)
    newer = store.accept(replace(FOUND, residual=0.2), DEVICES, now=NOW + timedelta(1))
    standing = store.status("payload", DEVICES, NOW + timedelta(90.9))
    assert standing.condition == "valid"
    assert standing.record == read_record(newer)
    late = store.status("payload", DEVICES, NOW + timedelta(94))
    assert (late.condition, late.why) == ("expired", "expired 3 days ago")
    assert late.fix == "Run 'touchdown calibrate payload --bench lab.toml --accept'."


def test_a_calibration_belongs_to_its_devices_and_to_its_kind_of_bench(store) -> None:
    store.accept(FOUND, DEVICES, now=NOW)
    other = {**DEVICES, "force_torque": DeviceName(maker="W", model="Six", serial="F2")}
    assert store.status("payload", other, NOW).condition == "other device"
    assert "force_torque F1" in store.status("payload", other, NOW).why
    # The arm is no part of a payload, and devices that are not there yet are not compared.
    assert store.status("payload", {"arm": other["force_torque"]}, NOW).condition == "valid"
    elsewhere = CalibrationStore(store.folder, "simulated")
    assert elsewhere.status("payload", DEVICES, NOW).condition == "missing"


def test_a_device_that_tells_no_number_goes_by_the_name_of_its_port(store) -> None:
    """The links of an emulated bench lie in another folder each time it is started."""

    def by_port(port: str) -> dict[str, DeviceName]:
        return {**DEVICES, "force_torque": DeviceName(maker="W", model="Six", serial=port)}

    store.accept(FOUND, by_port("links-1/force_torque"), now=NOW)
    for port, condition in (
        ("links-2/force_torque", "valid"), ("links-1/other", "other device"),
    ):  # fmt: skip
        assert store.status("payload", by_port(port), NOW).condition == condition


@pytest.mark.promise("D13")
def test_a_changed_or_broken_file_is_said_and_not_used(store) -> None:
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
def test_what_cannot_be_applied_is_damaged_though_its_hash_fits(
    store: CalibrationStore, what: CalibrationName
) -> None:
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


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of the size of files")
def test_a_disk_that_takes_no_more_keeps_the_calibration_before(store: CalibrationStore) -> None:
    import resource

    before = store.accept(of_kind("camera"), DEVICES, now=NOW).read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        with pytest.raises(InputError):
            store.accept(of_kind("camera"), DEVICES, now=NOW + timedelta(hours=1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    standing = store.status("camera", DEVICES, NOW)
    assert standing.condition == "valid"
    kept = [path for path in store.folder.rglob("*") if path.is_file()]
    assert [path.read_bytes() for path in kept] == [before]


def test_a_bench_that_needs_them_is_refused_by_name_with_the_fix(store) -> None:
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
