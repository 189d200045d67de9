"""Facts as JSON and back, so that a journal can be read by people and replayed by the program.

Arrays become ``{"shape", "dtype", "data"}`` with base64 of little-endian bytes; episodes keep only
what the screen needs, their signals live in the episode file named beside them. A float that is
not finite becomes the text ``nan``, ``inf`` or ``-inf``, so that every line is standard JSON.
"""

from __future__ import annotations

import base64
import dataclasses
import math
import types
import typing
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from backend.core.facts import (
    ActionChosen,
    ApprovalAwaited,
    BeliefUpdated,
    CalibrationMeasured,
    CampaignBegan,
    DecisionAwaited,
    EpisodeDecided,
    EpisodeRecorded,
    Fact,
    FaultRaised,
    FaultsReset,
    Gripped,
    HandOverAwaited,
    MountingAwaited,
    Noticed,
    OriginChecked,
    OutcomeAwaited,
    PatchEstimated,
    Paused,
    PhaseEntered,
    PhotoKept,
    ProbeCollected,
    Progress,
    Refused,
    Released,
    RunFinished,
    RunStarted,
    Said,
    SetUpAwaited,
    StabilityJudged,
    TrialFinished,
    TrialStarted,
)
from backend.core.faults import InputError

FORMAT = 1
# The name of each event in a log: written to disk, so it stays when a class is renamed.
_RECORDED: dict[str, type[Fact]] = {
    "RunStarted": RunStarted,
    "TrialStarted": TrialStarted,
    "PhaseEntered": PhaseEntered,
    "EpisodeRecorded": EpisodeRecorded,
    "PatchEstimated": PatchEstimated,
    "BeliefUpdated": BeliefUpdated,
    "StabilityJudged": StabilityJudged,
    "ActionChosen": ActionChosen,
    "ApprovalAwaited": ApprovalAwaited,
    "SetUpAwaited": SetUpAwaited,
    "OutcomeAwaited": OutcomeAwaited,
    "PhotoKept": PhotoKept,
    "Released": Released,
    "TrialFinished": TrialFinished,
    "RunFinished": RunFinished,
    "CampaignBegan": CampaignBegan,
    "Gripped": Gripped,
    "OriginChecked": OriginChecked,
    "CalibrationMeasured": CalibrationMeasured,
    "DecisionAwaited": DecisionAwaited,
    "HandOverAwaited": HandOverAwaited,
    "MountingAwaited": MountingAwaited,
    "ProbeCollected": ProbeCollected,
    "EpisodeDecided": EpisodeDecided,
    "FaultRaised": FaultRaised,
    "Paused": Paused,
    "Noticed": Noticed,
    "FaultsReset": FaultsReset,
    "Progress": Progress,
    "Said": Said,
    "Refused": Refused,
}
_KIND_OF = {cls: kind for kind, cls in _RECORDED.items()}
_DTYPES = {"float64", "float32", "bool", "uint8"}


def encode(fact: Fact) -> dict[str, Any]:
    """Return ``fact`` as a JSON-ready dictionary with its kind."""
    return {"kind": _KIND_OF[type(fact)], **_fields(fact)}


def decode(line: dict[str, Any], where: str) -> Fact:
    """Return the fact of a dictionary made by ``encode``; raises ``InputError``."""
    kind = line.get("kind")
    cls = _RECORDED.get(kind) if isinstance(kind, str) else None
    if cls is None:
        raise InputError(f"Unknown fact {kind!r}.", where, "Use a newer Touchdown to replay it.")
    try:
        fact = _build(cls, line)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"Damaged fact {kind}: {error}.", where, "Replay the lines before."
        ) from error
    assert isinstance(fact, Fact)
    return fact


def _fields(value: Any) -> dict[str, Any]:
    skip = {"recording"}
    return {
        f.name: _encoded(getattr(value, f.name))
        for f in dataclasses.fields(value)
        if f.name not in skip
    }


def _encoded(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        little = array.astype(array.dtype.newbyteorder("<"))
        data = base64.b64encode(little.tobytes()).decode("ascii")
        return {"shape": list(array.shape), "dtype": array.dtype.name, "data": data}
    if isinstance(value, Enum):
        return value.name
    if dataclasses.is_dataclass(value):
        return _fields(value)
    if isinstance(value, tuple):
        return [_encoded(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return value


@cache
def _hints(cls: type) -> dict[str, Any]:
    """Return the types of the fields: worked out anew for every fact they took half the time."""
    return typing.get_type_hints(cls)


def _build(cls: type, content: dict[str, Any]) -> Any:
    hints = _hints(cls)
    values = {
        f.name: _decoded(hints[f.name], content[f.name])
        for f in dataclasses.fields(cls)
        if f.name in content
    }
    return cls(**values)


def _decoded(hint: Any, value: Any) -> Any:
    if isinstance(value, dict) and "dtype" in value and "shape" in value:
        return _array(value)
    if hint is float:
        return float(value)
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        inner = [arg for arg in typing.get_args(hint) if arg is not type(None)]
        return None if value is None else _decoded(inner[0], value)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint[value]
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _build(hint, value)
    if origin is tuple:
        args = typing.get_args(hint)
        repeated = len(args) == 2 and args[1] is Ellipsis
        return tuple(
            _decoded(args[0] if repeated else args[i], item) for i, item in enumerate(value)
        )
    return value


def _array(value: dict[str, Any]) -> np.ndarray[Any, Any]:
    if value["dtype"] not in _DTYPES:
        raise ValueError(f"dtype {value['dtype']!r} is not allowed")
    dtype = np.dtype(value["dtype"]).newbyteorder("<")
    flat = np.frombuffer(base64.b64decode(value["data"], validate=True), dtype=dtype)
    return flat.reshape(value["shape"]).astype(value["dtype"])
