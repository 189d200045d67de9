"""Stage 1, noise of the sensors at rest, and the delays and compliance of stage 2."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import lfilter, welch

from touchdown.backend.core import FINGERS, FloatArray, Recording
from touchdown.backend.identification import recordings
from touchdown.backend.identification.estimates import Estimate, estimate, spread_estimate

LEAST_REST_S, GOOD_REST_S = 30.0, 300.0
BLOCK_S = 1.0  # means of this length show the drift
GRID_SHARE = 0.1  # of the lateness of a picture moves the grid of the next ones


@dataclass(frozen=True, slots=True)
class Chart:
    """Chart of a stage: named ``curves`` (n,) over ``x`` (n,), in ``units`` of x and curves.

    Curves of stage 1 are spectral densities, others values of presses or grippings, NaN where
    unknown. Those of shape (3, n) also have the ends of 95 % intervals.
    """

    stage: int
    title: str
    units: tuple[str, str]
    x: FloatArray
    curves: dict[str, FloatArray]


@dataclass(frozen=True, slots=True)
class RestResult:
    """Figures of a recording at rest. ``facts``: further rows of name and text for the report."""

    estimates: tuple[Estimate, ...]
    spectra: tuple[Chart, ...]
    facts: tuple[tuple[str, str], ...]


def walk_rate(means: FloatArray, white_var: float, block_s: float) -> tuple[float, float]:
    """Return the rate of a random walk per √s and its standard uncertainty (maximum likelihood).

    ``means`` (n, k): means of k independent channels over consecutive blocks; ``white_var``:
    variance of such a mean by white noise. Differences of neighbours have the variance
    2 v + 2 r² T / 3 and the covariance r² T / 6 - v.
    """
    steps = np.diff(means, axis=0)
    count = len(steps)
    # Eigenvalues and vectors of a symmetric tridiagonal Toeplitz matrix
    k = np.arange(1, count + 1)
    cosine = np.cos(np.pi * k / (count + 1))
    modes = np.sqrt(2.0 / (count + 1)) * np.sin(np.pi * np.outer(k, k) / (count + 1))
    power = (modes @ steps) ** 2

    def cost(log_rate: float) -> float:
        walk = np.exp(2.0 * log_rate) * block_s
        variance = 2.0 * white_var + 2.0 * walk / 3.0 + 2.0 * cosine * (walk / 6.0 - white_var)
        variance = np.maximum(variance, 1e-30)[:, None]
        return 0.5 * float((np.log(variance) + power / variance).sum())

    scale = np.log(max(float(steps.std()), 1e-12))
    found = minimize_scalar(cost, bounds=(scale - 9.0, scale + 3.0), method="bounded")
    at, h = float(found.x), 0.05
    curvature = (cost(at + h) - 2.0 * cost(at) + cost(at - h)) / h**2
    rate = float(np.exp(at))
    return rate, rate / np.sqrt(max(curvature, 1e-3))


def identify_rest(rest: recordings.RestRecording) -> RestResult:
    """Return noise, drift and timing of wrist sensor and cameras at rest in air."""
    blocks = rest.blocks
    wrench = np.concatenate([block.wrench for block in blocks])
    rate_hz = 1.0 / float(np.median(np.diff(blocks[0].wrench_t_s)))
    estimates, spectra, facts = [], [], []
    for name, unit, part in (("n", "N", slice(0, 3)), ("nm", "N·m", slice(3, 6))):
        own = wrench[:, part]
        white = np.diff(own, axis=0).std(axis=0) / np.sqrt(2.0)
        value = float(np.sqrt((white**2).mean()))
        error = value / np.sqrt(own.size) + white.std() / np.sqrt(3)
        estimates.append(estimate(f"wrist.white_{name}", value, error))
        length = round(BLOCK_S * rate_hz)
        means = own[: len(own) // length * length].reshape(-1, length, 3).mean(axis=1)
        walk = np.sqrt(60.0) * np.array(walk_rate(means, value**2 / length, BLOCK_S))
        estimates.append(estimate(f"wrist.drift_{name}_sqrt_min", walk[0], walk[1]))
        f_hz, density = welch(own, rate_hz, nperseg=min(4096, len(own)), axis=0)
        mean = density[1:-1].mean(axis=1)
        spectra.append(_spectrum("wrist", unit, f_hz, density))
        peak, ratio = f_hz[1 + int(mean.argmax())], float(mean.max() / np.median(mean))
        facts.append((f"quantisation of the wrist sensor, {unit}", f"{quantum(own):.3g}"))
        facts.append((f"strongest line, {unit}", f"{peak:.1f} Hz, {ratio:.1f} times the floor"))
    estimates.append(estimate("wrist.rate_hz", float(f"{rate_hz:.3g}"), 1e-3 * rate_hz))
    found, more, spectrum = _cameras(blocks)
    for finger, level in zip(FINGERS, rest.levels, strict=True):
        more.append((f"flicker, {finger}", flicker(level, lossless=rest.lossless)))
    return RestResult((*estimates, *found), (*spectra, spectrum), (*facts, *more))


def quantum(values: FloatArray) -> float:
    """Return the smallest step between values (n, k), 0 if they are not quantised."""
    steps = np.diff(np.unique(values[:, 0]))
    return float(np.median(steps)) if len(steps) < 0.05 * len(values) else 0.0


def flicker(levels: FloatArray, *, lossless: bool) -> str:
    """Return the variation of the mean grey levels (n,) as text; a bound after compression."""
    if len(levels) < 10:
        return "not recorded: the recording has no images"
    share = 100.0 * float(levels.std() / levels.mean())
    text = f"{share:.3f} % of the level"
    return text if lossless else f"at least {text}: compressed images"


def grid_numbers(t_s: FloatArray) -> FloatArray:
    """Return the numbers (n,) of pictures on a regular grid; some come late and some never.

    The numbers of a driver do not count the pictures that a camera or a busy computer left out.
    """
    period, due, numbers = float(np.median(np.diff(t_s))), t_s[0], np.zeros(len(t_s))
    for k, at in enumerate(t_s):
        steps = np.rint((at - due) / period)
        late = at - due - steps * period
        due, period = at - (1.0 - GRID_SHARE) * late, period + GRID_SHARE**2 / 4.0 * late
        numbers[k] = numbers[k - 1] + steps
    return numbers


def _spectrum(of: str, unit: str, f_hz: FloatArray, density: FloatArray) -> Chart:
    curves = {"density": density[1:-1].mean(axis=1)}
    return Chart(1, f"Noise spectrum, {of}", ("Hz", f"{unit}²/Hz"), f_hz[1:-1], curves)


def _cameras(blocks: Sequence[Recording]) -> tuple[list[Estimate], list[tuple[str, str]], Chart]:
    series, gaps, periods, white, lost, dropped, frames = [], [], [], [], [], 0, 0
    for finger in FINGERS:
        own = [[f for f in block.fields if f.finger == finger] for block in blocks]
        fields = [f for part in own for f in part]
        for part in (few for few in own if len(few) > 2):  # others show no period
            t_s = np.array([f.t_s for f in part])
            number = grid_numbers(t_s)
            period, start = np.polyfit(number, t_s, 1)
            periods.append(period)
            gaps.append(t_s - start - period * number)
            dropped += int(number[-1]) + 1 - len(part)
        frames += len(fields)
        moved = np.array([f.displacement_px for f in fields])
        seen = np.concatenate([recordings.seen_in(block, finger) for block in blocks])
        lost.append(float((~seen).mean()))
        white.append(float(np.diff(moved[:, seen.all(axis=0)], axis=0).std() / np.sqrt(2.0)))
        weight = seen[..., None].astype(float)
        series.append((weight * moved).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0))
    period = float(np.median(periods))
    apart_s = period * (1.0 + dropped / frames)  # on average, with the dropped pictures
    per_block = max(round(BLOCK_S / apart_s), 1)
    length = min(map(len, series)) // per_block * per_block
    blocked = [s[:length].reshape(-1, per_block, 2).mean(axis=1) for s in series]
    means = np.concatenate(blocked, axis=1)
    both = float(np.mean(white))
    shift = float(np.mean([np.diff(s, axis=0).std() / np.sqrt(2.0) for s in series]))
    rate, sd = walk_rate(means, shift**2 / per_block, per_block * apart_s)
    # Quartiles of a uniform distribution: some late pictures do not count.
    jitter = float(np.subtract(*np.quantile(np.concatenate(gaps), (0.75, 0.25))))
    share, error = dropped / max(frames + dropped, 1), np.sqrt(max(dropped, 1)) / max(frames, 1)
    estimates = [
        estimate("tactile.white_px", both, 0.02 * both),
        estimate("tactile.drift_px_sqrt_s", rate, sd),
        estimate("tactile.rate_hz", float(f"{1.0 / period:.3g}"), 1e-3 / period),
        estimate("tactile.jitter_s", jitter, 0.05 * jitter + 1e-4),
        estimate("tactile.drop_share", share, error),
        estimate("tactile.lost_share", float(np.mean(lost)), float(np.ptp(lost)) / 2 + 2e-4),
    ]
    f_hz, density = welch(series[0], 1.0 / period, nperseg=min(512, len(series[0])), axis=0)
    spectrum = _spectrum("mean marker", "px", f_hz, density)
    return estimates, [("frames", f"{frames}, {dropped} dropped")], spectrum


def identify_air(presses: recordings.PressSet, drift_px: float, *, rest: bool) -> list[Estimate]:
    """Return the errors after tare and reference, from the air before each press.

    ``drift_px``: of the markers per √s. Without a recording at ``rest`` also the white noise of the
    wrist sensor.
    """
    # Along z the gels still recover from the press before.
    air, px = presses.air_wrench, presses.air_px[..., 0]
    # Tare (200 samples) and reference (10 frames, 1.5 s of drift) add to the draw of a probe.
    tare = presses.air_sd.mean(axis=0) * np.sqrt(1.0 / 200.0 + 1.0 / 250.0)
    shift = np.hypot(1.2 * drift_px, 0.01)
    result = []
    for key, part, extra in (
        ("wrist.offset_n", air[:, :3], tare[:3]), ("wrist.offset_nm", air[:, 3:], tare[3:]),
        ("tactile.bias_px", px, np.full(1, shift)),
    ):  # fmt: skip
        freedom = part.size - part.shape[1]
        result.append(spread_estimate(key, part - part.mean(axis=0), extra, freedom))
    for key, first in () if rest else (("wrist.white_n", 0), ("wrist.white_nm", 3)):
        sd = presses.air_sd[:, first : first + 3]
        value = float(np.sqrt((sd**2).mean()))
        result.append(estimate(key, value, sd.std() / np.sqrt(sd.size) + 0.005 * value))
    return result


def estimate_delays(
    presses: Sequence[recordings.PressRecording], most: int = 40
) -> dict[str, FloatArray]:
    """Return the delays of each press in s, in three series, NaN where undetermined.

    ``command_pose``: measured behind commanded descent; ``pose_wrench``: force behind travel;
    ``wrench_markers``: vertical shear behind force.
    """
    chosen = presses[:: max(1, len(presses) // most)]
    found = [_delays_of(press) for press in chosen]
    names = ("command_pose", "pose_wrench", "wrench_markers")
    return {name: np.array([one[k] for one in found]) for k, name in enumerate(names)}


# Error of a delay that no scatter shows: cycle of the arm, touch of a tilted face
DELAY_SYSTEMATIC_S = {"command_pose": 2e-4, "pose_wrench": 1.5e-3, "wrench_markers": 1e-3}
CREEP_S = 0.5  # time constant of the creep that the delay is separated from


def _delays_of(press: recordings.PressRecording) -> tuple[float, float, float]:
    s, onset_s = press.signals, press.onset_s
    t_s = np.arange(onset_s - 0.15, onset_s + 1.9, 0.004)
    depth = float(np.interp(onset_s, s.pose_t_s, s.pose_mm[:, 2])) - s.pose_mm[:, 2]
    width = max(round(0.004 / float(np.median(np.diff(s.wrench_t_s)))), 1)
    force = np.interp(t_s, s.wrench_t_s, uniform_filter1d(s.wrench[:, 2], width))
    lag = np.nan
    if len(s.command_t_s) > 2:
        air = (s.pose_t_s < onset_s - 0.02) & (s.pose_t_s > onset_s - 0.25)
        behind = s.pose_mm[:, 2] - np.interp(s.pose_t_s, s.command_t_s, s.command_mm[:, 2])
        speed = np.gradient(s.pose_mm[:, 2], s.pose_t_s)
        if air.any() and abs(float(speed[air].mean())) > 0.2:
            lag = -float((behind[air] / speed[air]).mean())

    def springs(delay_s: float, touch_mm: float) -> list[FloatArray]:
        travel = np.maximum(np.interp(t_s - delay_s, s.pose_t_s, depth) - touch_mm, 0.0)
        return [np.ones_like(t_s), travel, _low_pass(travel, 0.004 / CREEP_S)]

    pose = _shift(lambda d, touch: _left_over(springs(d, touch), force))
    shear_t, shear = _mean_shear(press)
    at = (shear_t > onset_s - 0.15) & (shear_t < onset_s + 1.9)

    def loads(delay_s: float) -> list[FloatArray]:
        pull = np.interp(shear_t[at] - delay_s, t_s, force)
        slow = np.interp(shear_t[at] - delay_s, t_s, _low_pass(force, 0.004 / CREEP_S))
        return [np.ones(int(at.sum())), pull, slow]

    markers = np.nan
    if at.sum() > 10:
        markers = _shift(lambda d, _: _left_over(loads(d), shear[at]))
    return lag, pose, markers


def _shift(left: Callable[[float, float], FloatArray]) -> float:
    """Return the delay that minimises the residuals ``left(delay_s, touch_mm)``."""

    def both(v: FloatArray) -> FloatArray:
        return left(float(v[0]), float(v[1]))

    fits = [
        least_squares(both, (d, 0.0), bounds=([-0.15, -0.3], [0.25, 0.3]), x_scale=(0.01, 0.05))
        for d in (-0.02, 0.01, 0.05)
    ]
    return float(min(fits, key=lambda fit: float(fit.cost)).x[0])


def _left_over(columns: list[FloatArray], target: FloatArray) -> FloatArray:
    matrix = np.stack(columns, axis=1)
    found, *_ = np.linalg.lstsq(matrix, target, rcond=None)
    return np.asarray(target - matrix @ found)


def _low_pass(values: FloatArray, share: float) -> FloatArray:
    follow = lfilter([share], [1.0, share - 1.0], values - values[0])
    return np.asarray(values[0] + follow)


def _mean_shear(press: recordings.PressRecording) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) and the mean vertical shear (n,) of the inner rows of both fingers, px."""
    inner = slice(18, 45)  # rows 2 to 4 stay in the picture
    fields = [f for f in press.signals.fields if np.isfinite(f.displacement_px[inner]).all()]
    return (
        np.array([f.t_s for f in fields]),
        np.array([-float(f.displacement_px[inner, 1].mean()) for f in fields]),
    )


def delay_estimates(series: dict[str, FloatArray]) -> tuple[list[Estimate], recordings.Delays]:
    """Return the delays, and those to be taken out of the time stamps: the significant ones."""
    found = {}
    for name, values in series.items():
        real = values[np.isfinite(values)]
        if len(real) < 5:
            continue
        middle = float(np.median(real))
        sd = 1.4826 * float(np.median(np.abs(real - middle)))
        sigma = float(np.hypot(1.25 * sd / np.sqrt(len(real)), DELAY_SYSTEMATIC_S[name]))
        found[name] = estimate(f"delay.{name}", middle, sigma)
    taken = [found.get(name) for name in ("pose_wrench", "wrench_markers")]
    wrench, markers = (
        e.value if e is not None and abs(e.value) > max(3.0 * e.sigma, 0.004) else 0.0
        for e in taken
    )
    return list(found.values()), recordings.Delays(wrench, wrench + markers)


def arm_compliance(presses: Sequence[recordings.PressRecording]) -> list[Estimate]:
    """Return the stiffness of the arm along x, y and z, N/mm, from command, pose and wrench."""
    if any(len(press.signals.command_t_s) < 2 for press in presses):
        return []
    gap, force = (np.stack(part) for part in zip(*map(_yielding, presses), strict=True))
    work = np.maximum((force**2).sum(axis=1), 1e-9)
    slope = (force * gap).sum(axis=1) / work
    mean = (work * slope).sum(axis=0) / work.sum(axis=0)
    spread = np.sqrt((work * (slope - mean) ** 2).sum(axis=0) / work.sum(axis=0) / len(slope))
    return [
        estimate(f"arm.stiffness_{axis}", 1.0 / m, sd / m**2 + 0.005 / m)
        for axis, m, sd in zip("xyz", mean.tolist(), spread.tolist(), strict=True)
        if m > 0.0
    ]


def _yielding(press: recordings.PressRecording) -> tuple[FloatArray, FloatArray]:
    """Return pose less command (18, 3) and force (18, 3) in contact."""
    s, t_s = press.signals, press.onset_s + np.arange(0.2, 2.0, 0.1)
    pose = make_interp_spline(s.pose_t_s, s.pose_mm, k=1)(t_s)
    command = make_interp_spline(s.command_t_s, s.command_mm, k=1)(t_s)
    air = s.wrench[s.wrench_t_s < press.onset_s - 0.04, :3].mean(axis=0)
    means = [s.wrench[np.abs(s.wrench_t_s - t) < 0.02, :3].mean(axis=0) for t in t_s]
    return pose - command, np.stack(means) - air
