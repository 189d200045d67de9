"""Presses in the signals of a mapped recording, and what contradicts its mapping.

Presses are found by the change of the force vector, so that a wrong sign or axis does not hide
them. The checks need no calibration: while the hand goes down, the press force rises and the piece
moves the markers up, towards the hand.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import core
from touchdown.backend.config import TICK_S
from touchdown.backend.exchange import features
from touchdown.backend.exchange.features import ForeignEpisode
from touchdown.backend.exchange.mapping import (
    FORCE_N,
    LENGTH_MM,
    MOMENT_NM,
    NOMINAL_PX,
    SIGNALS,
    ImportMapping,
    MappingChange,
)
from touchdown.backend.sensing import STANDARD_GRAVITY_M_S2, assemble_episode

CONTACT_S, LENGTH_S = 0.6, 2.8  # time of contact in a press, and its length
AIR_S = (0.2, 0.55)  # tare and marker reference
HELD = slice(12, 18)  # ticks
NOISES = 6.0  # the force changes by more of its standard deviations at a contact
LEAST_S = 0.5  # shorter contacts are knocks
NUMBERS = 256  # presses an episode


def find_presses(values: Mapping[str, NDArray[Any]]) -> list[float]:
    """Return the times of contact in one recording."""
    t_s, wrench = values["wrench.t_s"], values["wrench"]
    rule = core.OnsetRule(rate_hz=min(1.0 / max(float(np.median(np.diff(t_s))), 1e-3), 1e3))
    # The force before the start counts as that at the start: a press may follow soon.
    grid = np.arange(t_s[0] - rule.lead / rule.rate_hz, t_s[-1], 1.0 / rule.rate_hz)
    force = np.stack([np.interp(grid, t_s, wrench[:, k]) for k in range(3)])
    start = force[:, rule.lead : rule.lead + rule.lead // 4 + 1]
    force[:, : rule.lead] = start.mean(axis=1, keepdims=True)
    noise_n = 1.05 * float(np.median(np.abs(np.diff(force)), axis=1).max())
    least_n = max(rule.threshold_n, NOISES * noise_n)
    rule = replace(rule, threshold_n=least_n, rise_n=0.3 * least_n)
    over = np.linalg.norm(core.force_over_baseline(force, rule), axis=0)[None]
    begin, found = 0, list[float]()
    while begin + rule.lead < len(grid):
        at = core.detect_contact(over[:, begin:], rule)
        if at[0] < 0:
            break
        onset_s = core.back_date_onset(grid[begin:], over[:, begin:], at, rule)[0]
        contact = begin + int(at[0])
        air = force[:, max(contact - rule.lead, 0) : contact - rule.lead // 2].mean(axis=1)
        away = np.linalg.norm(force[:, contact:] - air[:, None], axis=0) < least_n
        length = int(away.argmax()) if away.any() else len(away)
        if length >= LEAST_S * rule.rate_hz:
            found.append(float(onset_s))
        begin = contact + length + rule.lead
    return found


def cut_press(episode: ForeignEpisode, number: int, onset_s: float, mapping: ImportMapping
              ) -> ForeignEpisode:  # fmt: skip
    """Return the press ``number`` of a recording as an episode, with contact at ``CONTACT_S``."""
    values = episode.values
    t_s = {name: values[f"{name}.t_s"] - onset_s + CONTACT_S for name in mapping.sources}

    def rows(name: str, start_s: float = 0.0, end_s: float = LENGTH_S) -> NDArray[np.intp]:
        return np.flatnonzero((t_s[name] >= start_s) & (t_s[name] <= end_s))

    def in_air(name: str) -> core.FloatArray:
        air = values[name][rows(name, *AIR_S)]
        return np.asarray(air.mean(axis=0) if len(air) else np.full(air.shape[1:], np.nan))

    fields = []
    for finger in core.FINGERS:
        rest = in_air(finger)
        for row in rows(finger):
            place, state = values[finger][row].copy(), values[f"{finger}.state"][row].copy()
            at_s = float(t_s[finger][row])
            fields.append(core.MarkerField(finger, int(row), at_s, place, place - rest, state, 1.0))
    tare = in_air("wrench")
    recording = core.Recording(
        wrench_t_s=t_s["wrench"][rows("wrench")],
        wrench=values["wrench"][rows("wrench")] - tare,
        fields=tuple(sorted(fields, key=lambda field: field.t_s)),
        frames=(),
        pose_t_s=t_s["pose"][rows("pose")],
        pose_mm=values["pose"][rows("pose")],
        tare=tare,
    )
    origin_mm = mapping.pose.origin_mm
    offset_mm = _pose_mm(recording, CONTACT_S)[:2] - (origin_mm or (0.0, 0.0))
    found = assemble_episode(recording, onset_s=CONTACT_S, offset_mm=offset_mm, piece="")
    tactile, wrench = np.split(found.observation, [core.TACTILE_CHANNELS], axis=1)
    observed: dict[str, NDArray[Any]] = {features.MARKERS: tactile, features.FT: wrench}
    observed |= {} if origin_mm is None else {features.OFFSET: offset_mm}
    index = NUMBERS * episode.index + number
    names = {"unknown": "", "recording": episode.grip, "folder": episode.mounting}
    for name in set(t_s) - set(SIGNALS):
        row = max(int(np.searchsorted(t_s[name], CONTACT_S, "right")) - 1, 0)
        names[mapping.sources[name].source] = f"{values[name][row, 0]:.15g}"
    grip, mounting = names[mapping.grips.grip], names[mapping.grips.mounting]
    if mounting not in ("", episode.mounting):
        mounting = f"{episode.mounting}/{mounting}"
    return ForeignEpisode(index, features.FPS, observed, episode.side, recording, found.quality,
                          grip, mounting)  # fmt: skip


# Title, unit and axes of one signal of a press, times (n,) from the contact, values (n, axes).
PressCurves = tuple[str, str, str, core.FloatArray, core.FloatArray]


def press_curves(press: core.Recording) -> tuple[PressCurves, ...]:
    """Return force, moment, travel of the hand, and mean markers of each finger, for a preview."""
    hand_mm = press.pose_mm - press.pose_mm[press.pose_t_s >= CONTACT_S][:1].sum(axis=0)
    wrench_t_s = press.wrench_t_s - CONTACT_S
    found = [
        ("Force", "N", "xyz", wrench_t_s, press.wrench[:, :3]),
        ("Moment", "N\N{MIDDLE DOT}m", "xyz", wrench_t_s, press.wrench[:, 3:]),
        ("Hand from contact", "mm", "xyz", press.pose_t_s - CONTACT_S, hand_mm),
    ]
    for finger in core.FINGERS:
        own = [field for field in press.fields if field.finger == finger]
        mean = np.array([field.displacement_px.mean(axis=0) for field in own]).reshape(-1, 2)
        t_s = np.array([field.t_s for field in own]) - CONTACT_S
        found.append((f"Markers, {finger}", "px", "uv", t_s, mean))
    return tuple(one for one in found if np.isfinite(one[-1]).any())


def _pose_mm(recording: core.Recording, at_s: float) -> core.FloatArray:
    t_s, mm = recording.pose_t_s, recording.pose_mm.T
    return np.array([np.interp(at_s, t_s, axis) if len(t_s) else np.nan for axis in mm])


def measure_press(press: ForeignEpisode) -> dict[str, core.FloatArray]:
    """Return the changes from air to the end of a press; NaN where a signal has no samples.

    ``wrench`` (6,), and ``weight`` (6,) in air; ``pose`` (3,) in mm from contact, ``offset``
    (2,) of the label in mm, 0 without one. Of the fingers:
    ``shift`` (2, 2) in px, ``turn`` (2,) in rad from u towards v, and ``lag`` (2,) in s behind the
    force.
    """
    r, wrench = press.recording, press.values[features.FT]
    assert r is not None
    markers = press.values[features.MARKERS].reshape(-1, len(core.FINGERS), 2, core.MARKERS)
    held, (u, v) = markers[HELD].mean(axis=0), (NOMINAL_PX - NOMINAL_PX.mean(axis=0)).T
    force, moved = np.linalg.norm(wrench[:, :3], axis=1), np.linalg.norm(markers.mean(-1), axis=2)
    tick_s = TICK_S * np.arange(1, len(wrench) + 1)
    grid, lags = np.arange(0.1, 1.6, 0.01), np.arange(-0.4, 0.405, 0.01)
    wanted = np.interp(grid, tick_s, force)
    with np.errstate(invalid="ignore"):  # markers that stand still
        fit = [[np.corrcoef(wanted, np.interp(grid + lag, tick_s, own))[0, 1] for lag in lags]
               for own in moved.T]  # fmt: skip
    return {
        "wrench": wrench[HELD].mean(axis=0),
        "weight": r.tare,
        "pose": _pose_mm(r, CONTACT_S + tick_s[HELD][-1]) - _pose_mm(r, CONTACT_S),
        "offset": np.asarray(press.values.get(features.OFFSET, np.zeros(2))),
        "shift": held.mean(axis=-1),
        "turn": (u * held[:, 1] - v * held[:, 0]).sum(axis=1) / (u**2 + v**2).sum(),
        "lag": lags[np.argmax(fit, axis=1)],
    }


MOST_N, MOST_MM, LEAST_MM, MOST_PX, LEAST_PX = 300.0, 30.0, 0.02, 120.0, 0.5
MOST_LEVER_M, LEAST_LEVER_M, MOST_LAG_S, FAR_MM = 0.5, 1e-4, 0.08, 100.0
TURN_RAD, TURN_NM = 2e-3, 0.02  # smaller ones do not count
TURN_PRESSES = 4  # fewer do not tell a mirrored gel
USUAL_N, USUAL_LEVER_M, USUAL_MM = 8.0, 0.02, 1.0  # of a press; an unknown unit comes nearest


class Contradiction(NamedTuple):
    """A contradiction of the mapping, with values to try if they follow from the signals."""

    text: str
    changes: Sequence[MappingChange] = ()

    def __str__(self) -> str:
        tried = [f"{name} = {json.dumps(value)} in [{signal}]"
                 for signal, name, value in self.changes]  # fmt: skip
        return f"{self.text} Try {' and '.join(tried)}." if tried else self.text


def contradictions(presses: Sequence[Mapping[str, core.FloatArray]], mapping: ImportMapping
                   ) -> list[Contradiction]:  # fmt: skip
    """Return what contradicts the mapping, from the medians over presses.

    ``presses``: changes of ``measure_press``.
    """
    if not presses:
        return [Contradiction("No press was found: no force changes by 1 N for half a second. "
                              "Check 'source', 'stamp' and 'force_unit' of 'wrench'.")]  # fmt: skip
    whole = [one for one in presses if all(np.isfinite(value).all() for value in one.values())]
    middle = {name: np.median([one[name] for one in whole or presses[:1]], axis=0)
              for name in presses[0]}  # fmt: skip
    signals = (middle["wrench"], middle["pose"], *middle["shift"])
    missing = [f"'{name}' has no samples at the presses: its 'stamp' or 'time_offset_s'."
               for name, value in zip(SIGNALS, signals, strict=True)
               if not np.isfinite(value).all()]  # fmt: skip
    # A wrong sign elsewhere also reverses the turns.
    return [Contradiction(text) for text in missing] or [
        *_hand_checks(middle, mapping), *_marker_checks(middle, mapping)
    ] or [*_turn_checks(presses, mapping)]  # fmt: skip


def _unit(signal: str, name: str, own: str, factors: Mapping[str, float], ratio: float
          ) -> list[MappingChange]:  # fmt: skip
    """Return the unit that makes ``ratio``, of a value to the usual one, come nearest to 1."""
    sizes = {abs(np.log(max(ratio, 1e-12) * factor / factors[own])): unit
             for unit, factor in factors.items()}  # fmt: skip
    best = sizes[min(sizes)]
    return [] if best == own else [(signal, name, best)]


def _axes(
    signal: str, own: Sequence[str], change: core.FloatArray, sign: float
) -> list[MappingChange]:
    """Return the axes turned so that the largest ``change`` goes along z, with this sign."""
    at = int(np.abs(change).argmax())
    axes = [own[(at + k) % 3] for k in (1, 2, 3)]
    if sign * change[at] < 0.0:
        axes[1:] = [one[1:] if one.startswith("-") else f"-{one}" for one in axes[1:]]
    return [(signal, "axes", axes)]


def _hand_checks(middle: Mapping[str, core.FloatArray], mapping: ImportMapping
                 ) -> Iterator[Contradiction]:  # fmt: skip
    wrench, weight, travel = middle["wrench"], middle["weight"], middle["pose"]
    own, pose, payload_kg = mapping.wrench, mapping.pose, mapping.wrench.payload_kg
    force_n, size_mm = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(travel))
    lever_m = float(np.linalg.norm(wrench[3:])) / max(force_n, 1e-9)
    force_axis, travel_axis = ("xyz"[np.abs(one[:3]).argmax()] for one in (wrench, travel))
    if force_n > MOST_N:
        unit = _unit("wrench", "force_unit", own.force_unit, FORCE_N, force_n / USUAL_N)
        yield Contradiction(f"A press of {force_n:.0f} N: 'force_unit' of 'wrench'.", unit)
    if force_axis != "z":
        text = (f"The force changes most along {force_axis} while pressed ({force_n:.1f} N in all, "
                f"Fz {wrench[2]:+.1f} N): 'axes' of 'wrench'.")  # fmt: skip
        yield Contradiction(text, _axes("wrench", own.axes, wrench[:3], 1.0))
    elif wrench[2] < 0.0:
        other = "environment" if own.acts_on == "tool" else "tool"
        text = (f"Fz falls by {-wrench[2]:.1f} N while the arm goes "
                f"{'down' if travel[2] < 0.0 else 'up'}: "
                "sign ('acts_on') or frame ('axes') of 'wrench'.")  # fmt: skip
        yield Contradiction(text, [("wrench", "acts_on", other)])
    if not LEAST_LEVER_M <= lever_m <= MOST_LEVER_M:
        text = (f"The moment has a lever of {lever_m:.3g} m, too "
                f"{'short' if lever_m < LEAST_LEVER_M else 'long'} for a hand: 'moment_unit' of "
                "'wrench'.")  # fmt: skip
        ratio = lever_m / USUAL_LEVER_M
        yield Contradiction(text, _unit("wrench", "moment_unit", own.moment_unit, MOMENT_NM, ratio))
    due_n = -STANDARD_GRAVITY_M_S2 * (payload_kg or 0.0)
    if payload_kg is not None and abs(weight[2] - due_n) > 1.0 - 0.25 * due_n:
        text = (f"Fz in still air is {weight[2]:+.1f} N, the payload weighs {due_n:+.1f} N: unit, "
                "'axes' or 'acts_on' of 'wrench', or a sensor that was tared.")  # fmt: skip
        ratio = max(abs(weight[2] / due_n), 1.0)  # less is a tared sensor
        yield Contradiction(text, _unit("wrench", "force_unit", own.force_unit, FORCE_N, ratio))
    if not LEAST_MM <= size_mm <= MOST_MM:
        unit = _unit("pose", "unit", pose.unit, LENGTH_MM, size_mm / USUAL_MM)
        yield Contradiction(f"The arm travels {size_mm:.3g} mm in contact: 'unit' of 'pose'.", unit)
    elif travel_axis != "z" or travel[2] > 0.0:
        way = f"travels along {travel_axis}"
        way = f"goes up by {travel[2]:.2f} mm" if travel_axis == "z" else way
        text = f"The arm {way} while pressed: 'axes' of 'pose'."
        yield Contradiction(text, _axes("pose", pose.axes, travel, -1.0))
    elif (far_mm := float(np.abs(middle["offset"]).max())) > FAR_MM:
        yield Contradiction(f"The face lies {far_mm:.0f} mm off the bottom that it touches: "
                            "'origin_mm', in mm, or 'axes' of 'pose'.")  # fmt: skip


def _marker_checks(middle: Mapping[str, core.FloatArray], mapping: ImportMapping
                   ) -> Iterator[Contradiction]:  # fmt: skip
    for finger, (u, v), lag_s in zip(core.FINGERS, middle["shift"], middle["lag"], strict=True):
        own = getattr(mapping, finger)
        quarters = round(float(np.angle(complex(-v, -u))) / (0.5 * np.pi)) % 4  # left from up
        if not LEAST_PX <= np.hypot(u, v) <= MOST_PX:
            yield Contradiction(
                f"The markers of '{finger}' move by {np.hypot(u, v):.2g} px while pressed: "
                f"'kind', unit or 'source' of '{finger}', or a piece not gripped."
            )
            continue
        if quarters:
            way = ("up", "left", "down", "right")[quarters]
            text = f"The markers of '{finger}' move {way} while pressed, not up: its 'turn_deg'."
            yield Contradiction(text, [(finger, "turn_deg", (own.turn_deg - 90 * quarters) % 360)])
        if abs(lag_s) > MOST_LAG_S:
            text = (f"The markers of '{finger}' move {abs(lag_s):.2f} s "
                    f"{'after' if lag_s > 0.0 else 'before'} the force: its 'time_offset_s'."
                    )  # fmt: skip
            offset_s = round(own.time_offset_s - float(lag_s), 2)
            yield Contradiction(text, [(finger, "time_offset_s", offset_s)])


def _turn_checks(presses: Sequence[Mapping[str, core.FloatArray]], mapping: ImportMapping
                 ) -> Iterator[Contradiction]:  # fmt: skip
    """Compare the turn of the gels with the moment about y, which turns the piece in the grasp."""
    moment = np.array([press["wrench"][4] for press in presses])
    turns = np.array([press["turn"] for press in presses]) * (-1.0, 1.0)  # facing cameras
    sure = np.abs(moment) > TURN_NM
    moment, turns = moment[sure], turns[sure]
    # A shift also turns the pictures, both alike: that cancels between presses, and in their mean.
    if len(moment) >= TURN_PRESSES and moment.std() > TURN_NM:
        away, turned = moment - moment.mean(), turns - turns.mean(axis=0)
        against = away @ turned < -0.5 * np.linalg.norm(away) * np.linalg.norm(turned, axis=0)
    else:
        both = turns.mean(axis=1)
        against = np.full(2, np.sign(both * moment)[np.abs(both) > TURN_RAD].sum() < 0)
    if against.all():
        yield Contradiction("The gels turn against the moment about y: 'left' and 'right' are "
                            "exchanged, or 'mirror' is wrong.")  # fmt: skip
        return
    for finger in np.array(core.FINGERS)[against]:
        text = f"The gel of '{finger}' turns against the moment about y: its 'mirror'."
        yield Contradiction(text, [(str(finger), "mirror", not getattr(mapping, finger).mirror)])
