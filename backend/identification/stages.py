"""The stages of an identification: fits, split by gripping, replay gate, results on disk.

Each stage stores its result under the hash of its inputs, so that a cancelled identification
continues.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import SAMPLES_PER_PROBE, TICK_S, SimulationSettings, bench_sha256
from touchdown.backend.core import FINGERS, FloatArray, InputError, parse_json, write_atomically
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.identification.estimates import (
    Estimate,
    estimate,
    log_estimate,
    mean_estimate,
    spread_estimate,
)
from touchdown.backend.identification.fitting import (
    HOLD,
    ChannelNoise,
    FitResult,
    GlsFit,
    Layout,
    fit_roll_off,
)
from touchdown.backend.identification.press_model import (
    CHANNELS,
    LATE,
    PressModel,
    Unknown,
    field_basis,
    measured_channels,
    project_fields,
    unknowns_of,
)
from touchdown.backend.identification.recordings import STEPS_PER_TICK, PressSet, Recordings

Json = dict[str, Any]
Tell = Callable[[str, int, int], None]  # stage, done, total
VERSION = 4  # of the stored results; raised when a stage computes something else
STARTS, START_PRESSES, ROUNDS, EVALUATIONS = 3, 36, 10, 6
USUAL_ROUNDS = 4  # expected for the remaining time; a later round adds its own
# After the first round a fit with a larger misfit is repeated with the next larger error of the
# model, a share of the signals: otherwise what the model lacks determines the stiffness.
LARGEST_MISFIT, DISCREPANCIES = 2.0, (0.01, 0.02, 0.05, 0.1)
SETTLED = 0.5  # a round that moves no unknown by more of its uncertainty is the last
EARLY = 4  # tick of the slopes for the start
DRAGGED_MM = 0.25  # least travel of the hand along y in a press that drags
SLIPPED = 0.1  # largest relative error of the friction of a press that slipped
HELD_OUT = 3  # every third gripping is held out
CONDITIONED = 2  # first presses of a held-out gripping, which give its own values
SYSTEMATIC = 0.005  # relative error of tracker and model that no scatter shows


@dataclass(frozen=True, slots=True)
class StageStore:
    """Results of stages below ``folder``, by name and hash of ``key``."""

    folder: Path
    key: str

    def get(self, name: str, compute: Callable[[], Json]) -> Json:
        """Return the stored result, or compute and store it."""
        digest = hashlib.sha256(f"{VERSION} {name} {self.key}".encode()).hexdigest()[:20]
        path = self.folder / f"{name}-{digest}.json"
        with suppress(OSError, ValueError):  # not there, or damaged: computed again
            found: Json = parse_json(path.read_bytes())
            return found
        result = compute()
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(result).encode())
        return result


def stage_key(recordings: Recordings, nominal: SimulationSettings) -> str:
    """Return the text that identifies the inputs of all stages."""
    return " ".join([bench_sha256(nominal), *recordings.sha256])


def split_grips(presses: PressSet) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the presses to fit and those held out: whole grippings of each mounting."""
    held: list[int] = []
    for mounting in np.unique(presses.mounting):
        grips = np.unique(presses.grip[presses.mounting == mounting])
        held += [int(g) for k, g in enumerate(grips) if k % HELD_OUT == HELD_OUT - 1]
    if not held:
        raise InputError(
            "No gripping can be held out: each mounting has fewer than three.", "recordings",
            "Record more with `touchdown collect --plan gel`.",
        )  # fmt: skip
    out = np.isin(presses.grip, held)
    return np.flatnonzero(~out), np.flatnonzero(out)


def channel_noise(
    presses: PressSet, basis: FloatArray, drift_n: FloatArray, drift_px: float
) -> ChannelNoise:
    """Return the noise of the channels, from the air before contact and the drift at rest.

    ``drift_n`` (2,): of force and moment per √s.
    """
    sd = presses.air_sd.mean(axis=0)
    early = presses.field_px[:, :1]
    _, misfit = project_fields(early, presses.seen[:, :1], basis)
    marker_px = float(np.sqrt(np.median(misfit)))
    # Amplitude errors of a uniform shift and of independent markers
    energy = (basis[0, :3] ** 2).sum(axis=(1, 2))
    shift = np.array([basis[0, 0, :, 0].sum(), abs(basis[0, 1, :, 1].sum()), 0.0]) / energy
    white = marker_px / np.sqrt(energy)
    return ChannelNoise(
        white=np.r_[sd / 10.0, white, white],
        base=np.r_[sd / np.sqrt(250.0), white / 2.0, white / 2.0],
        walk=np.r_[np.repeat(drift_n, 3), shift * drift_px, shift * drift_px],
    )


@dataclass(frozen=True, slots=True)
class Mechanics:
    """Fit of ``presses``: solution, layout, basis. ``converged``: the last round moved little.

    ``discrepancy``: error of the press model over the size of the signals, 0 if noise explains all.
    """

    presses: PressSet
    layout: Layout
    fit: FitResult
    roll_off_mm: FloatArray
    roll_off_cov: FloatArray
    converged: bool
    discrepancy: float = 0.0

    def of(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return the values of one unknown, one per mounting or grip, and their errors.

        The standard uncertainties of logarithms are relative.
        """
        unknown = next(u for u in self.layout.unknowns if u.name == name)
        place = self.layout.parts[name]
        return np.asarray(unknown.outer(self.fit.x[place])), self.fit.sigma[place]


def fit_mechanics(
    presses: PressSet, nominal: SimulationSettings, library: PieceLibrary, drift: FloatArray,
    store: StageStore, tell: Tell,
) -> Mechanics:  # fmt: skip
    """Fit the press model to ``presses`` from several starts; ``drift`` (3,): N, N·m, px per √s.

    Each round renews the covariance of the presses and is stored; rounds end when one moves no
    unknown by more than ``SETTLED`` of its uncertainty.
    """
    pitch = nominal.tactile.pitch_mm

    def shape() -> Json:
        found, covariance = fit_roll_off(presses, pitch, nominal.tactile.roll_off_mm)
        return {"roll_off_mm": found.tolist(), "covariance": covariance.tolist()}

    marker_field = store.get("field", shape)
    roll_off = np.array(marker_field["roll_off_mm"])
    basis = field_basis(pitch, (float(roll_off[0]), float(roll_off[1])))
    few = presses.take(np.arange(0, len(presses), -(-len(presses) // START_PRESSES)))
    unknowns = unknowns_of(nominal)
    work = np.r_[np.repeat(len(few), STARTS), np.repeat(len(presses), ROUNDS)] * EVALUATIONS

    def fit(
        part: PressSet, layout: Layout, begin: FloatArray, step: int, name: str, error: float = 0.0
    ) -> Json:
        """Fit one start or round, the number ``step`` of all, with an ``error`` of the model."""
        noise = channel_noise(part, basis, drift[:2], float(drift[2]))
        done = [0.0]

        def count() -> None:
            done[0] = min(done[0] + len(part) / (len(unknowns) + 5), float(work[step]))
            expected = work[: max(STARTS + USUAL_ROUNDS, step + 1)]
            tell(name, int(work[:step].sum() + done[0]), int(expected.sum()))

        model = PressModel(part, nominal, library)
        channels = measured_channels(part, basis)
        run = GlsFit(model, layout, channels, noise, discrepancy=error, tell=count)
        found = asdict(run.run(begin, EVALUATIONS))
        return {key: np.asarray(value).tolist() for key, value in found.items()}

    layout = Layout(unknowns, few.mounting, few.grip)
    common = layout.parts

    def search(k: int) -> Json:
        rng = np.random.default_rng([7, k]) if k else None
        begin = _start(few, layout, basis=basis, rng=rng)
        return fit(few, layout, begin, k, f"start {k + 1} of {STARTS}")

    starts = [store.get(f"start{k}", partial(search, k)) for k in range(STARTS)]
    best = np.array(min(starts, key=lambda one: float(one["cost"]))["x"])
    layout = Layout(unknowns, presses.mounting, presses.grip)
    x = _start(presses, layout, basis=basis, rng=None)
    for u in unknowns:
        if u.scope == "common":
            x[layout.parts[u.name]] = best[common[u.name]]
    begin, error, larger = x, 0.0, list(DISCREPANCIES)
    for k in range(ROUNDS):
        name = f"fit, round {k + 1}"
        found = store.get(f"round{k}", partial(fit, presses, layout, x, STARTS + k, name, error))
        stored: Json = {k: np.array(v) if isinstance(v, list) else v for k, v in found.items()}
        result = FitResult(**stored)
        x = result.x
        unexplained = result.misfit > LARGEST_MISFIT and larger
        if unexplained and k:
            x, error = begin, larger.pop(0)
        elif result.moved < SETTLED and not unexplained:
            break
    covariance = np.array(marker_field["covariance"])
    settled = result.moved < SETTLED
    return Mechanics(presses, layout, result, roll_off, covariance, settled, error)


def _start(
    presses: PressSet, layout: Layout, *, basis: FloatArray, rng: np.random.Generator | None
) -> FloatArray:
    """Return a start: stiffness and scales from the slopes, the rest nominal or drawn."""

    def begin(u: Unknown) -> float:
        if rng is None or u.scope != "common":
            return float(u.inner(u.start))
        return rng.uniform(float(u.inner(u.low)), float(u.inner(u.high)))

    x = layout.vector(begin)
    channels = measured_channels(presses, basis)[:, EARLY]
    travel = -presses.motion_mm[:, (EARLY + 1) * STEPS_PER_TICK - 1, 2]
    guesses = {
        "shear": 0.5 * channels[:, 2] / travel, "scale_left": channels[:, 7] / travel,
        "scale_right": channels[:, 10] / travel,
    }  # fmt: skip
    for name, values in guesses.items():
        column = layout.column(name)
        for place in np.unique(column):
            x[place] = np.log(max(float(np.median(np.abs(values[column == place]))), 1e-3))
    return x


def mechanics_estimates(found: Mechanics) -> list[Estimate]:
    """Return the parameters of the population of grippings and mountings, and their spreads."""
    presses = found.presses
    shear, errors = found.of("shear")
    grips = len(shear)
    mean = mean_estimate("grasp.shear_n_mm", shear, shear * np.hypot(errors, SYSTEMATIC))
    result = [mean]
    for key, name in (
        ("grasp.normal_n_mm", "normal_ratio"), ("grasp.torsion_nmm_rad", "torsion_ratio"),
    ):  # fmt: skip
        (ratio,), (error,) = found.of(name)
        scatter = mean.sigma / mean.value
        freedom = grips - 1 if error < scatter else 1000
        result.append(
            log_estimate(key, mean.value * ratio, float(np.hypot(scatter, error)), freedom)
        )
    for key, name, floor in (
        ("grasp.hysteresis_s", "relax_s", 0.05), ("face.foundation_n_mm3", "foundation", 0.03),
    ):  # fmt: skip
        (value,), (error,) = found.of(name)
        result.append(log_estimate(key, value, float(np.hypot(error, floor))))
    (value,), (error,) = found.of("alpha")
    result.append(estimate("grasp.hysteresis_share", value, float(np.hypot(error, 0.01))))
    for k, value in enumerate(found.roll_off_mm.tolist()):
        sigma = float(np.hypot(np.sqrt(found.roll_off_cov[k, k]), 0.003 * value))
        result.append(estimate(f"tactile.roll_off_mm.{k}", value, sigma))
    gains, gain_errors = [], []
    for k, name in enumerate(("scale_left", "scale_right")):
        scale, relative = found.of(name)
        one = mean_estimate("", scale, scale * np.hypot(relative, SYSTEMATIC))
        inverse = one.sigma / one.value**2
        result.append(estimate(f"tactile.mm_per_px.{k}", 1.0 / one.value, inverse, grips - 1))
        gains.append(scale / one.value - 1.0)
        gain_errors.append(relative)
    tilts, tilt_errors = np.concatenate([found.of("tilt_x"), found.of("tilt_y")], axis=1)
    prints, print_errors = found.of("print_y")
    height = {g: float(np.median(presses.contact_mm[presses.grip == g])) for g in presses.grip}
    heights = np.array(list(height.values()))
    within = presses.contact_mm - np.array([height[g] for g in presses.grip])
    handed = float(np.median([r.sigma_mm for r in presses.recordings])) > 0.3
    seat = "spread.grasp_offset_mm" if handed else "spread.jig_mm"
    gain = np.stack(gains), np.stack(gain_errors), 2 * (grips - 1)
    result += [
        spread_estimate("spread.gel", shear / mean.value - 1.0, errors, grips - 1),
        spread_estimate("spread.gain", *gain),
        spread_estimate("spread.tilt_rad", tilts, tilt_errors, len(tilts)),
        spread_estimate("spread.print_offset_mm", prints, print_errors, len(prints)),
        spread_estimate(seat, heights - heights.mean(), np.full(1, 0.03), grips - 1),
        spread_estimate("arm.repeatability_mm", within, np.zeros(1), len(within) - grips),
    ]
    return result


def finger_decays(found: Mechanics, pitch_mm: float) -> Json:
    """Return the decay of the marker field along x and z of each gel: estimates ``of`` fields."""
    result = []
    for k, finger in enumerate(FINGERS):
        own = found.presses.seen & (np.arange(2) == k)[:, None]
        begin = (float(found.roll_off_mm[0]), float(found.roll_off_mm[1]))
        values, cov = fit_roll_off(replace(found.presses, seen=own), pitch_mm, begin)
        sigma = np.hypot(np.sqrt(np.diag(cov)), 0.003 * values)
        result += [asdict(estimate(f"decay.{finger}.{axis}", value, error))
                   for axis, value, error in zip("xz", values, sigma, strict=True)]  # fmt: skip
    return {"of": result}


def dilation_estimate(presses: PressSet, found: Mechanics, pitch_mm: float) -> Estimate:
    """Return the growth of the marker field with the pad force.

    A lateral force F_y loads one pad and relieves the other by half of it: N / F_g - 1 is plus and
    minus F_y / (2 F_g). The scatter between grippings gives the uncertainty.
    """
    basis = field_basis(pitch_mm, (float(found.roll_off_mm[0]), float(found.roll_off_mm[1])))
    amplitude, _ = project_fields(presses.field_px[:, HOLD], presses.seen[:, HOLD], basis)
    scale = np.array([found.of(name)[0].mean() for name in ("scale_left", "scale_right")])
    grown = amplitude[..., 3].mean(axis=1) / scale @ (0.5, -0.5)
    grip_n = np.array([r.probe.grip_force_n for r in presses.recordings])
    load = presses.wrench[:, HOLD, 1].mean(axis=1) / (2.0 * grip_n)
    power = max(float(load @ load), 1e-12)
    value = float(load @ grown) / power
    rest, grips = load * (grown - value * load), np.unique(presses.grip)
    scatter = np.array([rest[presses.grip == g].sum() for g in grips])
    sigma = float(np.sqrt(scatter @ scatter * len(grips) / max(len(grips) - 1, 1))) / power
    return estimate("tactile.dilation", value, float(np.hypot(sigma, 0.05 * value)), len(grips) - 1)


def friction_estimates(key: str, mu: FloatArray, sigma: FloatArray) -> list[Estimate]:
    """Return the friction ``key`` and its spread; nothing from fewer than three presses."""
    if len(mu) < 3:
        return []
    one = mean_estimate(key, mu, mu * sigma)
    return [one, spread_estimate(f"spread.{key}", mu / one.value - 1.0, sigma, len(mu) - 1)]


def correlations(found: Mechanics) -> tuple[tuple[str, ...], FloatArray]:
    """Return names and correlation matrix of common unknowns and means over grippings."""
    names = tuple(u.name for u in found.layout.unknowns if u.scope != "mounting")
    rows = np.zeros((len(names), found.layout.size))
    for k, name in enumerate(names):
        rows[k, found.layout.parts[name]] = 1.0 / len(found.layout.parts[name])
    covariance = rows @ found.fit.covariance @ rows.T
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    return names, covariance / np.outer(sd, sd)


@dataclass(frozen=True, slots=True)
class Gate:
    """Comparison of predictions of held-out presses by the identified and the nominal bench.

    ``nominal``, ``identified``: root mean square residuals over the noise, by phase and channel
    (3, 8). ``share``: what is left of the nominal error above noise, as a ratio of rms; ``better``:
    number of held-out grippings that the identified bench predicts better, of ``grips``.
    ``example``: measured, nominal and identified Fz (20,) and left shear (20,) of one press.
    """

    nominal: FloatArray
    identified: FloatArray
    share: float
    better: int
    grips: int
    presses: int
    example: FloatArray

    @property
    def accepted(self) -> bool:
        """True if the identified bench predicts the held-out presses better."""
        return bool(self.share < 1.0 and 2 * self.better > self.grips)


PHASES = ("touch", "ramp", "hold")
GATE_CHANNELS = (*CHANNELS[:6], "left markers", "right markers")


def judged_presses(held: PressSet) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first presses of each gripping, and those that are predicted from them.

    The first are ``CONDITIONED`` of a gripping, or all but one; a single press is left out. Raises
    ``InputError`` if no gripping has two.
    """
    first: list[int] = []
    judged: list[int] = []
    for grip in np.unique(held.grip):
        rows = np.flatnonzero(held.grip == grip).tolist()
        known = min(CONDITIONED, len(rows) - 1)
        if known:
            first += rows[:known]
            judged += rows[known:]
    if not judged:
        raise InputError(
            "No held-out gripping has two valid presses.", "recordings",
            "Record more presses a gripping with `touchdown collect --plan gel`.",
        )  # fmt: skip
    return np.array(first), np.array(judged)


def replay_gate(
    held: PressSet, found: Mechanics, nominal: SimulationSettings, library: PieceLibrary,
    drift: FloatArray,
) -> Gate:  # fmt: skip
    """Predict the ``held`` presses by both benches, from the first presses of each gripping.

    No bench file holds the values of a gripping itself. Each bench estimates them from the first
    presses, with its mean values and the spreads of the fitted grippings as prior, and predicts the
    others. ``drift`` (3,): N, N·m, px per √s.
    """
    known = {m: k for k, m in enumerate(np.unique(found.presses.mounting))}
    fitted, spread = {}, {}
    for unknown in found.layout.unknowns:
        values, _ = found.of(unknown.name)
        if unknown.scope == "mounting":
            fitted[unknown.name] = values[[known[m] for m in held.mounting]]
        else:
            mean = 0.0 if unknown.name == "grasp_x" else float(values.mean())
            fitted[unknown.name] = np.full(len(held), mean)
            spread[unknown.name] = float(np.std(unknown.inner(values))) + 1e-3
    plain = {u.name: np.full(len(held), u.start) for u in unknowns_of(nominal)}
    # Delays, and tilt and position of a mounting, are no part of a bench file: both get them.
    shared = (u.name for u in found.layout.unknowns if u.scope == "mounting" or u.name in LATE)
    plain |= {name: fitted[name] for name in shared}
    if not nominal.grasp.hysteresis:
        plain["alpha"] = np.zeros(len(held))
    first, judged = judged_presses(held)
    early, late = held.take(first), held.take(judged)
    pitch, usual = nominal.tactile.pitch_mm, nominal.tactile.roll_off_mm
    own = (float(found.roll_off_mm[0]), float(found.roll_off_mm[1]))
    _, misfit = project_fields(late.field_px[:, :1], late.seen[:, :1], field_basis(pitch, own))
    marker_px = float(np.sqrt(np.median(misfit)))
    layout = Layout(
        tuple(u for u in found.layout.unknowns if u.scope == "grip"), early.mounting, early.grip
    )
    number = np.searchsorted(np.unique(early.grip), late.grip)

    def predicted(
        bench: dict[str, FloatArray], roll_off: tuple[float, float]
    ) -> tuple[FloatArray, FloatArray]:
        """Estimate the values of each gripping from its first presses and predict the others."""
        basis = field_basis(pitch, roll_off)
        start = layout.vector(lambda u: float(u.inner(bench[u.name][0])))
        fit = GlsFit(
            PressModel(early, nominal, library, {k: v[first] for k, v in bench.items()}), layout,
            measured_channels(early, basis),
            channel_noise(early, basis, drift[:2], float(drift[2])),
            prior=(start, layout.vector(lambda u: spread[u.name])), discrepancy=found.discrepancy,
        )  # fmt: skip
        x = fit.run(start).x
        own = {u.name: u.outer(x[layout.parts[u.name]])[number] for u in layout.unknowns}
        values = {k: v[judged] for k, v in bench.items()} | own
        return _normalised(PressModel(late, nominal, library), values, basis, marker_px, drift)

    squares, series = zip(predicted(plain, usual), predicted(fitted, own), strict=True)
    phase = _phases(late)
    tables = [
        np.stack([np.sqrt(np.nanmean(np.where((phase == p)[..., None], s, np.nan), axis=(0, 1)))
                  for p in range(len(PHASES))]) for s in squares
    ]  # fmt: skip
    by_grip = np.array(
        [[np.nanmean(s[late.grip == g]) for g in np.unique(late.grip)] for s in squares]
    )
    above = [max(float(np.nanmean(s)) - 1.0, 1e-9) for s in squares]
    one = int(np.nanargmax(late.wrench[:, -1, 2]))
    measured = measured_channels(late, field_basis(pitch, own))
    pair = [2, 7]
    example = np.stack([measured[one][:, pair], *(channels[one][:, pair] for channels in series)])
    return Gate(
        tables[0], tables[1], float(np.sqrt(above[1] / above[0])),
        int((by_grip[1] < by_grip[0]).sum()), by_grip.shape[1], len(late), example,
    )  # fmt: skip


def _normalised(
    model: PressModel, values: dict[str, FloatArray], basis: FloatArray, marker_px: float,
    drift: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return mean squares (B, 20, 8) of the residuals over the noise, and the prediction."""
    held = model.presses
    predicted = model.predict(values)
    t_s = TICK_S * np.arange(1, SAMPLES_PER_PROBE + 1)
    white = held.air_sd.mean(axis=0) ** 2 * (1.0 / 100.0 + 1.0 / 250.0)
    noise = white + np.repeat(drift[:2] ** 2, 3) * t_s[:, None]
    wrench = (held.wrench - predicted[..., :6]) ** 2 / noise
    amplitude = predicted[..., 6:].reshape(len(held), SAMPLES_PER_PROBE, 2, 3)
    field = np.einsum("btfi,fima->btfma", amplitude, basis[:, :3])
    variance = marker_px**2 + float(drift[2]) ** 2 * t_s + 0.03**2
    left = ((held.field_px - field) ** 2).mean(axis=-1) * held.seen
    mean = left.sum(axis=-1) / np.maximum(held.seen.sum(axis=-1), 1)
    return np.concatenate([wrench, mean / variance[:, None]], axis=2), predicted


def _phases(presses: PressSet) -> NDArray[np.intp]:
    """Return (B, 20): phase of each tick."""
    t_s = TICK_S * np.arange(1, SAMPLES_PER_PROBE + 1)
    ramp_s = np.array([r.probe.ramp_fraction * r.probe.duration_s for r in presses.recordings])
    return np.where(t_s <= 0.2 + 1e-9, 0, np.where(t_s <= ramp_s[:, None] + 1e-9, 1, 2))


def fit_friction(
    presses: PressSet, found: Mechanics, nominal: SimulationSettings, library: PieceLibrary
) -> Json:
    """Return the friction of each press that slipped: ``mu`` and relative ``sigma``.

    It is that of the faces for presses dragged along y (all or none), else that of the pads.
    Stiffness and depth of each press are fitted with it by Gauss-Newton steps. The force limit of
    the pads is friction times grip force, so an error of the grip force is part of the friction.
    """
    model, count = PressModel(presses, nominal, library), len(presses)
    values = {
        u.name: np.full(count, float(found.of(u.name)[0].mean())) for u in found.layout.unknowns
    }
    for name in ("tilt_x", "tilt_y", "print_x", "print_y", "grasp_x"):
        values[name] = np.zeros(count)
    force = presses.wrench[..., :3]
    down = np.maximum(force[:, -1, 2], 0.5)
    name, seen, ratio = "mu_grip", [2], down / (2.0 * model.grip_force_n)
    if dragged(presses).any():
        name, seen, ratio = "mu", [1, 2], np.maximum(np.abs(force[:, -1, 1]) / down, 0.05)
    centre = np.stack([np.log(ratio), np.log(values["shear"]), np.zeros(count)], axis=1)
    sd = np.hypot(presses.air_sd[:, seen].mean(axis=0) / 10.0, 0.03)
    weight, steps = 1.0 / np.array([1.0, 0.15, 0.1]) ** 2, np.diag([0.02, 0.01, 0.01])

    def predict(at: FloatArray) -> FloatArray:
        own = {name: np.exp(at[:, 0]), "shear": np.exp(at[:, 1]), "deeper_mm": at[:, 2]}
        signals = model.predict({**values, **own})[..., seen] / sd
        return np.asarray(np.nan_to_num(signals, nan=0.0).reshape(count, -1))

    x, measured = centre, (force[..., seen] / sd).reshape(count, -1)
    for _ in range(6):
        at = predict(x)
        slopes = np.stack([(predict(x + step) - at) / step.sum() for step in steps], axis=2)
        hessian = np.einsum("btp,btq->bpq", slopes, slopes) + np.diag(weight)
        gradient = np.einsum("btp,bt->bp", slopes, measured - at) + (centre - x) * weight
        x = x + np.clip(np.linalg.solve(hessian, gradient[..., None])[..., 0], -0.3, 0.3)
    sigma, mu = np.sqrt(np.linalg.inv(hessian)[:, 0, 0]), np.exp(x[:, 0])
    slipped = sigma < SLIPPED
    if name == "mu":  # a slope of the bottom along y counts as friction
        slope = np.concatenate([found.of("tilt_x")[0], found.of("tilt_y")[0]]).std()
        sigma = np.hypot(sigma, slope * (mu + 1.0 / mu))
    return {"mu": mu[slipped].tolist(), "sigma": sigma[slipped].tolist()}


def dragged(presses: PressSet) -> NDArray[np.bool_]:
    """Return (B,): True for presses in which the hand moved along y, towards a finger."""
    return np.asarray(np.abs(presses.motion_mm[:, -1, 1]) > DRAGGED_MM)
