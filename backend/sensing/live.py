"""Live conversion of raw samples into marker fields and tared wrenches.

A stepped bench calls ``update`` after each step, a real one from a thread of its own. The object
holds tare and tactile references of the present probe.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from touchdown.backend.core import (
    FINGERS,
    WRENCH_CHANNELS,
    Finger,
    FloatArray,
    MarkerField,
    MarkerState,
    RawStreams,
    Recording,
    RefusedError,
    SampleStream,
    Stream,
)
from touchdown.backend.sensing import zeroing
from touchdown.backend.sensing.jpeg_damage import DamageCheckingTracker

PRESS_SAMPLES = 10  # 10 ms of the usual wrist sensor
# Markers of an idle bench that move by less between two pictures stand still; time between these.
STILL_PX, STILL_S = 0.3, 0.1


def looks_still(was: MarkerField | None, now: MarkerField | None) -> bool:
    """Return True if all markers of two fields were tracked and stand at the same places."""
    if was is None or now is None or not was.quality * now.quality > 0.0:
        return False
    return bool((now.state == was.state).all()) and not has_moved(was, now)


def has_moved(was: MarkerField | None, now: MarkerField | None) -> bool:
    """Return True if a marker seen in both fields moved; markers that come and go did not."""
    if was is None or now is None:
        return was is not now
    both = (was.state == MarkerState.SEEN) & (now.state == MarkerState.SEEN)
    moved_px = np.abs(now.position_px - was.position_px)[both]
    return not (moved_px <= STILL_PX).all()


class LiveSensing:
    """Converts the raw streams into ``fields`` (markers) and ``wrench`` (tared, N and N·m).

    ``payload`` (6,): calibrated weight below the sensor, subtracted before the first tare.
    """

    def __init__(
        self,
        raw: RawStreams,
        fields: Mapping[Finger, Stream[MarkerField]],
        wrench: SampleStream,
        payload: FloatArray,
    ) -> None:
        self.raw: RawStreams = raw
        self.fields: Mapping[Finger, Stream[MarkerField]] = fields
        self.wrench: SampleStream = wrench
        self._trackers = {finger: DamageCheckingTracker(finger) for finger in FINGERS}
        self._still = dict.fromkeys(FINGERS, False)
        self._in_air: dict[Finger, zeroing.TactileReference] = {}
        self._frame_cursor = {finger: raw.frames[finger].count for finger in FINGERS}
        self._sample_cursor = raw.samples.count
        self._payload = payload
        self._tare = zeroing.Tare(payload, np.zeros(WRENCH_CHANNELS))
        # Bench time of the last tare: a verdict reached before it belongs to a former probe.
        self.tare_s: float = float("-inf")
        # What is known of the wrist sensor's, for any thread; None while that is too little.
        self.drift: zeroing.WrenchDrift | None = None

    def update(self, still_s: float = 0.0) -> None:
        """Process all samples and frames since the last call.

        Markers that stand still are tracked every ``still_s`` only, on an idle bench.
        """
        for finger in FINGERS:
            frames, cursor, _ = self.raw.frames[finger].since(self._frame_cursor[finger])
            self._frame_cursor[finger] = cursor
            for frame in frames:
                last = self.fields[finger].newest()
                # The check for damage compares each JPEG with the one before.
                still = self._still[finger] and not frame.from_jpeg
                if still and last is not None and 0.0 <= frame.t_s - last.t_s < still_s:
                    continue
                field = self._trackers[finger].track(frame)
                if field is not None:
                    self._still[finger] = looks_still(last, field)
                    self.fields[finger].put(frame.t_s, field)
        samples = self.raw.samples.since(self._sample_cursor)
        self._sample_cursor = samples.cursor
        if len(samples.t_s):
            self.wrench.put(samples.t_s, self._tare.apply(samples.values))

    def zero_wrench(self, now_s: float, rest_s: float = 0.2) -> zeroing.Tare:
        """Take the tare from the last ``rest_s`` of raw samples in air."""
        window = self.raw.samples.window(now_s - rest_s, now_s)
        self._tare = zeroing.take_tare(window.t_s, window.values, self._payload)
        self.tare_s = now_s
        return self._tare

    def take_references(self, count: int) -> Mapping[Finger, zeroing.TactileReference]:
        """Take the tactile reference of both fingers from the newest ``count`` fields each.

        All later references must have the shape of the first ones, taken in air after gripping.
        Raises ``RefusedError`` if the piece touches something, or for a gel of another grid.
        """
        taken: dict[Finger, zeroing.TactileReference] = {}
        for finger in FINGERS:
            stream = self.fields[finger]
            newest, _, _ = stream.since(stream.count - count)
            grid = self._trackers[finger].tracker.grid
            if newest and newest[-1].quality == 0.0 and grid.rows and not grid.usable:
                raise RefusedError("grid", f"{finger}: {grid.message}.")
            taken[finger] = zeroing.take_reference(newest, self._in_air.get(finger))
        self._in_air = self._in_air or taken
        for finger, reference in taken.items():
            self._trackers[finger].tracker.set_reference(reference)
        return taken

    @property
    def references(self) -> Mapping[Finger, zeroing.TactileReference]:
        """References in use, by finger."""
        found = {finger: one.tracker.reference for finger, one in self._trackers.items()}
        return {finger: reference for finger, reference in found.items() if reference is not None}

    def forget_references(self) -> None:
        """Discard the shape in air; the piece is gripped again."""
        self._in_air = {}

    def recording(self, start_s: float, end_s: float) -> Recording:
        """Return the native-rate signals between two bench times."""
        wrench = self.wrench.window(start_s, end_s)
        poses = self.raw.poses.window(start_s, end_s)
        commands = self.raw.commands.window(start_s, end_s)
        fields = [f for finger in FINGERS for f in self.fields[finger].between(start_s, end_s)]
        frames = [f for finger in FINGERS for f in self.raw.frames[finger].between(start_s, end_s)]
        return Recording(
            wrench_t_s=wrench.t_s,
            wrench=wrench.values,
            fields=tuple(sorted(fields, key=lambda f: f.t_s)),
            frames=tuple(sorted(frames, key=lambda f: f.t_s)),
            pose_t_s=poses.t_s,
            pose_mm=poses.values,
            tare=self._tare.total,
            command_t_s=commands.t_s,
            command_mm=commands.values,
        )

    def press_n(self, now_s: float, max_age_s: float) -> float:
        """Return the mean press force (tared Fz, N) of the newest samples; NaN without any."""
        # A window of time is searched for sample by sample; this is called often.
        newest = self.wrench.since(self.wrench.count - PRESS_SAMPLES)
        fresh = newest.t_s >= now_s - max_age_s
        return float(np.mean(newest.values[fresh, 2])) if fresh.any() else float("nan")
