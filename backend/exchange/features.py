"""Features of an exchanged episode: names, types, shapes, arrays read from a foreign file.

The process that reads foreign files imports this module, so it imports little. Optional packages
are imported on use.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import TACTILE_CHANNELS, WRENCH_CHANNELS, EpisodeQuality, Recording

FPS = 10
TICK_NS = 1_000_000_000 // FPS
WINDOW = 100  # wrench samples per tick: 1 kHz
MARKERS, FT, FT_WINDOW = "observation.markers", "observation.ft", "observation.ft_window"
STATE, ACTION = "observation.state", "action"
OFFSET, PATCH = "label.offset_mm", "label.patch"
PICTURES = {"left": "observation.images.tac_left", "right": "observation.images.tac_right"}
SCENE = "observation.images.scene"
ENVIRONMENT = "observation.environment_state"
# Signals that ``state_with`` adds to the state, and the feature instead of it.
ADDED = {"wrench": FT, "markers": MARKERS}
STATE_WITH = (*ADDED, "environment_state")
# Definition of the action in an export, as stated in its manifest.
COMMANDED, MEASURED = "commanded", "measured"
Values = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Feature:
    """One named array: ``shape`` per tick, or once per episode if it is ``constant``."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    constant: bool = False
    names: tuple[str, ...] = ()


POSE_NAMES = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
FT_NAMES = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")


def short_name(key: str) -> str:
    """Return the name of a feature in robomimic files and replay buffers."""
    return key.removeprefix("observation.").removeprefix("images.").replace(".", "_")


def make_features(
    points: int, *, native: bool, state_with: Sequence[str] = ()
) -> tuple[Feature, ...]:
    """Return the features of episodes with ``points`` face points; ``native``: recordings too.

    ``state_with``: signals that the state holds besides the pose, see ``STATE_WITH``.
    """
    names = {"wrench": FT_NAMES, "markers": tuple(f"m{k:03d}" for k in range(TACTILE_CHANNELS))}
    added = tuple(name for signal in ADDED if signal in state_with for name in names[signal])
    apart = "environment_state" in state_with
    state = POSE_NAMES if apart else POSE_NAMES + added
    recorded = (
        Feature(FT_WINDOW, "float32", (WINDOW, WRENCH_CHANNELS)),
        Feature(STATE, "float32", (len(state),), names=state),
        *((Feature(ENVIRONMENT, "float32", (len(added),), names=added),) if apart else ()),
        Feature(ACTION, "float32", (7,), names=POSE_NAMES),
    )
    return (
        Feature(MARKERS, "float32", (TACTILE_CHANNELS,)),
        Feature(FT, "float32", (WRENCH_CHANNELS,), names=FT_NAMES),
        *(recorded if native else ()),
        Feature(OFFSET, "float32", (2,), constant=True, names=("x", "y")),
        Feature(PATCH, "uint8", (points,), constant=True),
    )


FACTS = "facts.json"
TRUSTED = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ForeignEpisode:
    """``values``: (T, ...) per feature. ``side`` of a split, or "".

    ``recording`` and ``quality`` belong to a press that a mapping file found; the checks of quality
    need signals that other files do not have.
    """

    index: int
    fps: float
    values: Mapping[str, NDArray[Any]]
    side: str = ""
    recording: Recording | None = None
    quality: EpisodeQuality = TRUSTED
    grip: str = ""  # of a press, "" if unknown; name of a mapped recording
    mounting: str = ""  # the same; its folder


class RecordedSignal(NamedTuple):
    """Topic of a bag, or feature of a data set: its messages, and the numbers in each."""

    name: str
    kind: str
    numbers: int  # 0: pictures, or none
    messages: int
    rate_hz: float


def save_foreign(episode: ForeignEpisode, path: Path) -> None:
    """Write an episode for the parent process: arrays without objects, metadata as JSON."""
    facts = {name: getattr(episode, name) for name in ("index", "fps", "side", "grip", "mounting")}
    text = np.frombuffer(json.dumps(facts).encode("utf-8"), np.uint8)
    np.savez(path, **{FACTS: text, **episode.values})  # type: ignore[arg-type]


def load_foreign(path: Path) -> ForeignEpisode:
    """Read the file of ``save_foreign``; no code in it is executed."""
    with np.load(path, allow_pickle=False) as stored:
        facts = json.loads(stored[FACTS].tobytes())
        values = {name: stored[name] for name in stored.files if name != FACTS}
    return ForeignEpisode(values=values, **facts)
