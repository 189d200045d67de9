"""Forward model of presses with given parameters, and its unknowns.

The measured path of the hand drives the grasp, so that the compliance of the arm does not enter.
A prediction has 12 channels at the 20 ticks: wrench at the sensor, and per finger the amplitudes of
the marker field along x, z and about the jaw axis (px, px, px/mm) in the basis of the gel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import simulation
from touchdown.backend.config import SAMPLES_PER_PROBE, TICK_S, SimulationSettings
from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import PieceLibrary, face_points
from touchdown.backend.identification.recordings import STEP_S, STEPS, STEPS_PER_TICK, PressSet

CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz", "left x", "left z", "left turn",
            "right x", "right z", "right turn")  # fmt: skip
SUBCELLS = 7  # a side of a cell of 1 mm; with 3 the moments err by 1 to 2 N·mm in a press of 6 N
# Conditions of the bench that the model leaves out, and their shapes
ABSENT: dict[str, Any] = {
    "yaw_rad": (), "crown_rad": (), "wrist_yaw_rad": (), "wrist_lever_mm": (3,), "ft_offset": (6,),
    "cable_n_mm": (3, 3), "print_offset_mm": (2,), "label_error_mm": (2,), "bias_px": (2, 2),
}  # fmt: skip
STIFF_ARM_N_MM = 1e6  # the measured hand does not yield
# Time stamps of a sensor behind the pose, as far as no delay was taken out, and its channels
LATE = {"late_wrench_s": slice(0, 6), "late_markers_s": slice(6, 12)}


@dataclass(frozen=True, slots=True)
class Unknown:
    """A parameter of the model: ``scope`` common, mounting or grip; ``low``, ``high``: its prior.

    ``log``: fitted as a logarithm. ``start``: nominal value.
    """

    name: str
    scope: str
    low: float
    high: float
    log: bool
    start: float

    def inner(self, value: float | FloatArray) -> FloatArray:
        """Return the fitted coordinate of a value."""
        return np.asarray(np.log(value) if self.log else value, dtype=np.float64)

    def outer(self, inner: FloatArray) -> FloatArray:
        """Return the value of a fitted coordinate."""
        return np.exp(inner) if self.log else inner

    @property
    def prior_sd(self) -> float:
        """Standard deviation of the uniform prior in the fitted coordinate."""
        return float((self.inner(self.high) - self.inner(self.low)) / np.sqrt(12.0))

    @property
    def prior_mean(self) -> float:
        """Mean of the prior in the fitted coordinate."""
        return 0.5 * float(self.inner(self.high) + self.inner(self.low))


def unknowns_of(nominal: SimulationSettings) -> tuple[Unknown, ...]:
    """Return the unknowns of presses without slip, with the values of the ``nominal`` bench."""
    grasp, face, shear = nominal.grasp, nominal.face, nominal.grasp.shear_n_mm
    scale = 1.0 / np.array(nominal.tactile.mm_per_px)
    alpha = grasp.hysteresis_share if grasp.hysteresis else 0.02
    return (
        Unknown("normal_ratio", "common", 1.0, 6.0, True, grasp.normal_n_mm / shear),
        Unknown("torsion_ratio", "common", 8.0, 128.0, True, grasp.torsion_nmm_rad / shear),
        Unknown("alpha", "common", 0.0, 0.5, False, alpha),
        Unknown("relax_s", "common", 0.1, 2.5, True, grasp.hysteresis_s),
        Unknown("foundation", "common", 2.0, 100.0, True, face.foundation_n_mm3),
        *(Unknown(name, "common", -0.006, 0.006, False, 0.0) for name in LATE),
        Unknown("tilt_x", "mounting", -0.04, 0.04, False, 0.0),
        Unknown("tilt_y", "mounting", -0.04, 0.04, False, 0.0),
        Unknown("print_x", "mounting", -0.35, 0.35, False, 0.0),
        Unknown("print_y", "mounting", -1.0, 1.0, False, 0.0),
        Unknown("shear", "grip", 1.0, 16.0, True, shear),
        Unknown("scale_left", "grip", 8.0, 35.0, True, scale[0]),
        Unknown("scale_right", "grip", 8.0, 35.0, True, scale[1]),
        Unknown("grasp_x", "grip", -3.5, 3.5, False, 0.0),
    )  # fmt: skip


Values = Mapping[str, FloatArray]  # value of each unknown for each press (B,)


class PressModel:
    """Predicts the presses of one ``PressSet`` from values per press.

    ``grasp_z_mm`` (B,): height of the pivot in the grasp, from the contact height. ``fixed``:
    values of unknowns that a prediction need not give.
    """

    def __init__(
        self, presses: PressSet, nominal: SimulationSettings, library: PieceLibrary,
        fixed: Values | None = None,
    ) -> None:  # fmt: skip
        self.presses, self.nominal, self.library = presses, nominal, library
        self.fixed = fixed or {}
        self._subcells = max(nominal.face.subcells, SUBCELLS)
        lattice = nominal.face.lattice_mm / self._subcells
        pairs = [(r.piece, r.bottom) for r in presses.recordings]
        self._groups: list[tuple[Any, Any, FloatArray, NDArray[np.intp]]] = []
        for piece, bottom in dict.fromkeys(pairs):
            top, under = library.top(piece), library.bottom(bottom)
            rows = np.array([k for k, pair in enumerate(pairs) if pair == (piece, bottom)])
            points = face_points(top.face, lattice)
            self._groups.append((top, under.upper or under.face, points, rows))
        self.grip_force_n = np.array([r.probe.grip_force_n for r in presses.recordings])
        heights = np.array([library.top(r.piece).grip_height_mm or 0.0 for r in presses.recordings])
        self.grasp_z_mm: FloatArray = presses.contact_mm - heights
        self.grasp_z_mm = self.grasp_z_mm - np.median(self.grasp_z_mm)

    def predict(self, values: Values) -> FloatArray:
        """Return (B, 20, 12); NaN for a press without equilibrium."""
        result = np.full((len(self.presses), SAMPLES_PER_PROBE, len(CHANNELS)), np.nan)
        values = {**self.fixed, **values}
        for top, outline, points, rows in self._groups:
            own = {name: np.broadcast_to(v, len(self.presses))[rows] for name, v in values.items()}
            result[rows] = self._press(top, outline, points, rows, own)
        return result

    def _press(
        self, top: Any, outline: Any, points: FloatArray, rows: NDArray[np.intp], v: Values
    ) -> FloatArray:
        face, count = self.nominal.face, len(rows)
        zero = np.zeros(count)
        shift = np.stack([v["grasp_x"] + v["print_x"], v["print_y"]], axis=1)
        conditions = self._conditions(top, rows, v)
        state = simulation.begin_probes(
            points, outline, self.presses.offset_mm[rows] - shift, conditions, None,
            face.lattice_mm / self._subcells, self._subcells,
        )  # fmt: skip
        path = self.presses.motion_mm[rows].copy()
        path[:, :, 2] -= v.get("deeper_mm", zero)[:, None]
        wrench = np.zeros((count, STEPS + 1, 6))
        strain = np.zeros((count, STEPS + 1, 2, 3))
        for step in range(STEPS):
            state, solved = simulation.advance_probes(state, path[:, step], STEP_S)
            wrench[:, step + 1], strain[:, step + 1] = solved.wrench_g, solved.strain
        last = slice(STEPS_PER_TICK, None, STEPS_PER_TICK)
        mean = 0.25 * wrench[:, :-2:2] + 0.5 * wrench[:, 1:-1:2] + 0.25 * wrench[:, last]
        wrist = self.nominal.wrist
        scale = np.stack([v["scale_left"], v["scale_right"]], axis=1)
        amplitude = strain[:, last] * scale[:, None, :, None]
        result = np.concatenate(
            [
                simulation.wrist_wrench(mean, wrist.height_mm, wrist.yaw_rad),
                amplitude.reshape(count, -1, 6),
            ],
            axis=2,
        )
        rate = np.gradient(result, TICK_S, axis=1)
        for name, own in LATE.items():
            result[..., own] -= v.get(name, zero)[:, None, None] * rate[..., own]
        result[~(state.residual <= simulation.RESIDUAL_LIMIT)] = np.nan
        return result

    def _conditions(self, top: Any, rows: NDArray[np.intp], v: Values) -> simulation.Conditions:
        nominal, grasp, count = self.nominal, self.nominal.grasp, len(rows)
        # Gripped area relative to that of the settings, as on the bench
        area = np.sqrt(top.width_mm / grasp.pad_width_mm) if grasp.pad_width_mm else 1.0
        ones, shear = np.ones(count), v["shear"] * area
        tilt = np.stack([v["tilt_x"], v["tilt_y"]], axis=1)
        offset = np.stack([v["grasp_x"], self.grasp_z_mm[rows]], axis=1)
        force_n = self.grip_force_n[rows]
        # Steps of this length are implicit: these values decay as the exact ones do, and give the
        # same force while the strain grows steadily.
        relax_s = STEP_S / np.expm1(STEP_S / v["relax_s"])
        return simulation.Conditions(
            shear_n_mm=shear,
            normal_n_mm=shear * v["normal_ratio"],
            torsion_nmm=shear * area * v["torsion_ratio"],
            width_mm=top.width_mm * ones,
            robot_n_mm=np.full((count, 3), STIFF_ARM_N_MM),
            grip_height_mm=(top.grip_height_mm or 0.0) * ones,
            grip_force_n=force_n,
            mu_grip=v.get("mu_grip", nominal.mu_grip * ones),
            limit_radius_mm=grasp.limit_radius_mm * np.sqrt(area) * ones,
            slips=np.full(count, "mu_grip" in v),
            grasp_offset_mm=offset,
            alpha=np.maximum(v["alpha"], 0.0) * v["relax_s"] / relax_s,
            relax_s=relax_s,
            creep=grasp.creep_share * ones,
            creep_s=grasp.creep_s * ones,
            mu=v.get("mu", nominal.mu * ones),
            foundation_n_mm3=v["foundation"],
            tangential_n_mm3=nominal.face.tangential_n_mm3 * ones,
            tilt_rad=tilt,
            gain=np.ones((count, 2)),
            **{name: np.zeros((count, *shape)) for name, shape in ABSENT.items()},
        )


def field_basis(pitch_mm: float, roll_off_mm: tuple[float, float]) -> FloatArray:
    """Return (2, 4, 63, 2): field of each finger for x, z, turn and squeeze of amplitude 1."""
    gel = simulation.build_gel((1.0, 1.0), pitch_mm, roll_off_mm, 1.0)
    return gel.map.reshape(2, 4, -1, 2)


def project_fields(
    field_px: FloatArray, seen: NDArray[np.bool_], basis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return amplitudes (..., 2, 4) of ``field_px`` (..., 2, 63, 2) and the misfit (..., 2), px².

    Markers that were not ``seen`` (..., 2, 63) do not count.
    """
    weight = seen.astype(np.float64)
    matrix = np.einsum("...fm,fima,fjma->...fij", weight, basis, basis)
    right = np.einsum("...fm,fima,...fma->...fi", weight, basis, field_px)
    found = np.linalg.solve(matrix + 1e-9 * np.eye(4), right[..., None])[..., 0]
    left = field_px - np.einsum("...fi,fima->...fma", found, basis)
    misfit = (weight * (left**2).sum(axis=-1)).sum(axis=-1) / np.maximum(2 * weight.sum(axis=-1), 1)
    return found, misfit


def measured_channels(presses: PressSet, basis: FloatArray) -> FloatArray:
    """Return (B, 20, 12): measured wrench and marker amplitudes."""
    found, _ = project_fields(presses.field_px, presses.seen, basis)
    flat = found[..., :3].reshape(len(presses), SAMPLES_PER_PROBE, 6)
    return np.concatenate([presses.wrench, flat], axis=2)
