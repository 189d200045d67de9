"""Read an episode file back into the values it was written from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from backend.config.method import SAMPLES_PER_PROBE
from backend.core.faults import InputError
from backend.core.flow import (
    CHANNELS,
    FINGERS,
    WRENCH_CHANNELS,
    Episode,
    EpisodeQuality,
    Finger,
    FloatArray,
    MarkerField,
    Recording,
    ScenePicture,
    TactileFrame,
)
from backend.dataset.channels import (
    COMMAND,
    IMAGE,
    LABEL,
    MARKER,
    OBS,
    POSE,
    SCENE,
    WRENCH,
    Times,
    unpack_json,
)
from backend.dataset.contents import FIX, Contents, explained, read_whole
from backend.dataset.pictures import decode
from backend.dataset.unpacking import (
    stamps_ns,
    unpack_image,
    unpack_markers,
    unpack_observation,
    unpack_pose_mm,
    unpack_wrench,
)


def to_s(ns: Times) -> FloatArray:
    """Return bench seconds; whole microseconds come back as the hand-wound clock gave them."""
    whole_us = ns % 1000 == 0
    return np.where(whole_us, (ns // 1000) * 1e-6, ns * 1e-9).astype(np.float64)


def read_episode(path: Path) -> Episode:
    """Read the episode ``path``, frames decoded; raises ``InputError`` naming a damaged file."""
    return episode_of(read_whole(path), path)


def episode_of(contents: Contents, path: Path) -> Episode:
    """Return the episode of a file that was read; raises ``InputError`` naming it if damaged."""
    if "pack" in contents.metadata:
        raise InputError(
            "The file is a pack of simulated episodes: no pictures were kept of them.",
            str(path),
            "Open them by the dataset that holds the pack.",
        )
    if "episode" not in contents.metadata:
        raise InputError("The file holds no single episode.", str(path), FIX)
    with explained(path):
        return _episode(contents)


def read_label(path: Path) -> dict[str, object] | None:
    """Return the label kept with an episode, or None."""
    messages = read_whole(path).messages.get(LABEL.name, [])
    with explained(path):
        return unpack_json(messages[-1]) if messages else None


def _episode(contents: Contents) -> Episode:
    facts = contents.metadata["episode"]
    observation = unpack_observation(contents.messages[OBS.name])
    if observation.shape != (SAMPLES_PER_PROBE, CHANNELS):
        raise ValueError(f"the observation has shape {observation.shape}, not (20, 258)")
    quality = json.loads(facts["quality"])
    quality["reasons"] = tuple(quality["reasons"])
    pairs = json.loads(contents.metadata["pairs"]["items"])
    return Episode(
        episode_id=facts["uuid"],
        piece=facts["grasped_piece"],
        observation=observation,
        offset_mm=np.array(json.loads(facts["offset_mm"]), dtype=np.float64).reshape(2),
        onset_s=float(json.loads(facts["onset_s"])),
        quality=EpisodeQuality(**quality),
        recording=_recording(contents) if facts["recording"] == "native" else None,
        metadata=tuple((str(key), str(value)) for key, value in pairs),
    )


def _recording(contents: Contents) -> Recording:
    wrench = contents.messages.get(WRENCH.name, [])
    pose = contents.messages.get(POSE.name, [])
    command = contents.messages.get(COMMAND.name, [])
    fields = [field for finger in FINGERS for field in _fields(contents, finger)]
    frames = [frame for finger in FINGERS for frame in _frames(contents, finger)]
    tare = json.loads(contents.metadata["calibration"]["tare"])
    return Recording(
        wrench_t_s=to_s(stamps_ns(wrench)),
        wrench=unpack_wrench(wrench),
        fields=tuple(sorted(fields, key=lambda field: field.t_s)),
        frames=tuple(sorted(frames, key=lambda frame: frame.t_s)),
        pose_t_s=to_s(stamps_ns(pose)),
        pose_mm=unpack_pose_mm(pose),
        scene=tuple(_scene(contents)),
        tare=np.array(tare, dtype=np.float64).reshape(WRENCH_CHANNELS),
        command_t_s=to_s(stamps_ns(command)),
        command_mm=unpack_pose_mm(command),
    )


def _fields(contents: Contents, finger: Finger) -> list[MarkerField]:
    topic = MARKER[finger].name
    messages = contents.messages.get(topic, [])
    rows, t_s = unpack_markers(messages), to_s(stamps_ns(messages))
    return [
        MarkerField(
            finger,
            contents.sequence[topic][i],
            float(t_s[i]),
            rows.position_px[i].copy(),
            rows.displacement_px[i].copy(),
            rows.state[i].copy(),
            float(rows.quality[i]),
            float(rows.residual_px[i]),
        )
        for i in range(len(messages))
    ]


def _scene(contents: Contents) -> list[ScenePicture]:
    messages = contents.messages.get(SCENE.name, [])
    t_s = to_s(stamps_ns(messages))
    return [
        ScenePicture(float(t_s[i]), decode(unpack_image(message)[1]))
        for i, message in enumerate(messages)
    ]


def _frames(contents: Contents, finger: Finger) -> list[TactileFrame]:
    topic = IMAGE[finger].name
    messages = contents.messages.get(topic, [])
    t_s = to_s(stamps_ns(messages))
    return [
        TactileFrame(
            finger, contents.sequence[topic][i], float(t_s[i]), decode(unpack_image(message)[1])
        )
        for i, message in enumerate(messages)
    ]
