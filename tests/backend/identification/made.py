"""Recordings of presses made from formulas, without the bench."""

import numpy as np

from touchdown.backend.config import ProbeSettings
from touchdown.backend.core import MarkerField, Recording
from touchdown.backend.identification.recordings import PressRecording, PressSet

ONSET_S = 0.3


def made_press(number=0, *, k_n_mm=5.0, wrench_late_s=0.0, markers_late_s=0.0, **changes):
    """Return a press at a force of ``k_n_mm`` per mm of travel, with 17 px of shear per mm."""
    t_s = np.arange(0.0, 2.4, 1e-3)
    command_t = np.arange(0.0, 2.4, 1e-2)
    rng = np.random.default_rng(number)

    def depth(at_s):
        after = np.clip(at_s - ONSET_S, 0.0, None)
        fast = np.minimum(after, 0.1)
        return 2.0 * fast + np.clip(after - 0.3, 0.0, 0.8)

    wrench = np.zeros((len(t_s), 6))
    wrench[:, 2] = k_n_mm * depth(t_s - wrench_late_s)
    wrench += 0.02 * rng.standard_normal(wrench.shape)
    pose = np.zeros((len(command_t), 3))
    pose[:, 2] = 30.0 - np.where(command_t < ONSET_S, 2.0 * (command_t - ONSET_S), depth(command_t))
    fields = []
    for finger, phase in (("left", 0.003), ("right", 0.021)):
        for k, at in enumerate(np.arange(phase, 2.4, 0.04)):
            moved = np.zeros((63, 2))
            moved[:, 1] = -17.0 * depth(at - wrench_late_s - markers_late_s)
            moved += 0.02 * rng.standard_normal(moved.shape)
            fields.append(
                MarkerField(finger, k, at, 100.0 + moved, moved, np.zeros(63, np.uint8), 1.0, 0.0)
            )
    signals = {
        "wrench_t_s": t_s, "wrench": wrench, "fields": tuple(sorted(fields, key=lambda f: f.t_s)),
        "frames": (), "pose_t_s": command_t, "pose_mm": pose, "tare": np.zeros(6),
        "command_t_s": command_t, "command_mm": pose,
    }  # fmt: skip
    facts = {
        "uuid": f"u{number}", "grip": f"g{number // 4}", "mounting": f"m{number // 12}",
        "piece": "pot", "bottom": "square15", "stage": "gel", "accepted": True,
        "offset_mm": rng.uniform(-6, 6, 2), "sigma_mm": 0.15, "onset_s": ONSET_S,
        "probe": ProbeSettings(),
    }  # fmt: skip
    signals |= {key: changes.pop(key) for key in list(changes) if key in signals}
    return PressRecording(**{**facts, **changes}, signals=Recording(**signals))


def made_set(offsets_mm, motion_mm, *, piece="mushroom", bottom="circle15", grips=None):
    """Return presses along one path ``motion_mm`` (40, 3), without signals."""
    count = len(offsets_mm)
    grip = np.zeros(count, int) if grips is None else np.array(grips)
    recordings = tuple(made_press(k, piece=piece, bottom=bottom) for k in range(count))
    sd = np.repeat([0.1, 0.004], 3)
    return PressSet(
        recordings,
        tuple(f"g{g}" for g in np.unique(grip)),
        ("m0",),
        grip,
        mounting=np.zeros(count, int),
        offset_mm=np.array(offsets_mm, float),
        contact_mm=np.full(count, 33.0),
        motion_mm=np.tile(motion_mm, (count, 1, 1)),
        wrench=np.zeros((count, 20, 6)),
        field_px=np.zeros((count, 20, 2, 63, 2)),
        seen=np.ones((count, 20, 2, 63), bool),
        air_wrench=np.zeros((count, 6)),
        air_sd=np.tile(sd, (count, 1)),
        air_px=np.zeros((count, 2, 2)),
    )
