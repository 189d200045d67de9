"""Write one episode as one MCAP file: native streams, what the model saw, label and metadata."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from backend.config.method import TICK_S
from backend.core.flow import (
    FINGERS,
    Episode,
    Finger,
    MarkerField,
    Recording,
    ScenePicture,
    TactileFrame,
)
from backend.core.program import program
from backend.dataset.channels import (
    COMMAND,
    EVENT,
    IMAGE,
    LABEL,
    MARKER,
    OBS,
    POSE,
    SCENE,
    WRENCH,
    MarkerRows,
    Times,
    pack_image,
    pack_json,
    pack_markers,
    pack_observation,
    pack_pose,
    pack_wrench,
)
from backend.dataset.container import McapWriter
from backend.dataset.contents import check_counts
from backend.dataset.pictures import ENCODING, KeepFrames, encode
from backend.dataset.records import Block, message_list, message_rows

SCHEMA_VERSION = "1"
TOPICS = (OBS, LABEL, EVENT, WRENCH, POSE, COMMAND, *MARKER.values(), *IMAGE.values())


def to_ns(t_s: ArrayLike) -> Times:
    """Return bench seconds as whole ns."""
    ns: Times = np.rint(np.asarray(t_s, dtype=np.float64) * 1e9).astype(np.int64)
    return ns


def write_episode(
    path: Path,
    episode: Episode,
    label: Mapping[str, object] | None,
    metadata: Mapping[str, str],
    keep_frames: KeepFrames = "jpeg95_444",
) -> None:
    """Write ``episode`` to ``path``: complete and durable, or not there.

    Stamps are those of the bench clock, in ns. ``metadata`` becomes the record ``bench``. Markers
    and wrench are kept bit for bit, images as ``keep_frames`` says. Raises ``OSError`` if the disk
    refuses; the caller still holds the episode.
    """
    scene = () if episode.recording is None else episode.recording.scene
    with McapWriter(path, (*TOPICS, SCENE) if scene else TOPICS) as writer:
        for name, values in _metadata(episode, metadata, keep_frames).items():
            writer.add_metadata(name, values)
        blocks = [_observation(writer, episode), *_notes(writer, episode, label)]
        if episode.recording is not None:
            blocks += _signals(writer, episode.recording)
        writer.add_chunk(blocks, compress=True)
        if episode.recording is not None and keep_frames != "none":
            images = _images(writer, episode.recording.frames, keep_frames)
            images += _scene(writer, scene, keep_frames)
            if images:
                writer.add_chunk(images, compress=False)
        counts = writer.finish()
        check_counts(writer.part, counts)


def _metadata(
    episode: Episode, metadata: Mapping[str, str], keep: KeepFrames
) -> dict[str, dict[str, str]]:
    recording = episode.recording
    tare = [] if recording is None else recording.tare.tolist()
    return {
        "episode": {
            "uuid": episode.episode_id,
            "grasped_piece": episode.piece,
            "offset_mm": json.dumps(episode.offset_mm.tolist()),
            "onset_s": json.dumps(episode.onset_s),
            "quality": json.dumps(dataclasses.asdict(episode.quality)),
            "keep_frames": keep,
            "recording": "none" if recording is None else "native",
        },
        "bench": dict(metadata),
        "calibration": {"tare": json.dumps(tare)},
        "clock": {"utc_minus_monotonic_ns": "0", "method": "bench clock"},
        "software": {"schema_version": SCHEMA_VERSION, "program": program()},
        "pairs": {"items": json.dumps(episode.metadata)},
    }


def _observation(writer: McapWriter, episode: Episode) -> Block:
    count = len(episode.observation)
    stamps = to_ns(episode.onset_s + TICK_S * np.arange(1, count + 1))
    rows = pack_observation(stamps, episode.observation)
    return message_rows(writer.channel[OBS.name], stamps, np.arange(count), rows)


def _notes(writer: McapWriter, episode: Episode, label: Mapping[str, object] | None) -> list[Block]:
    onset = int(to_ns([episode.onset_s])[0])
    event = pack_json({"event": "contact", "t_s": episode.onset_s})
    blocks = [message_list(writer.channel[EVENT.name], [onset], [0], [event])]
    if label is not None:
        channel = writer.channel[LABEL.name]
        blocks.append(message_list(channel, [onset], [0], [pack_json(label)]))
    return blocks


def _signals(writer: McapWriter, recording: Recording) -> list[Block]:
    blocks = []
    if len(recording.wrench_t_s):
        stamps = to_ns(recording.wrench_t_s)
        rows = pack_wrench(stamps, recording.wrench)
        channel = writer.channel[WRENCH.name]
        blocks.append(message_rows(channel, stamps, np.arange(len(stamps)), rows))
    for topic, t_s, position_mm in (
        (POSE, recording.pose_t_s, recording.pose_mm),
        (COMMAND, recording.command_t_s, recording.command_mm),
    ):
        if len(t_s):
            stamps = to_ns(t_s)
            rows = pack_pose(stamps, position_mm)
            channel = writer.channel[topic.name]
            blocks.append(message_rows(channel, stamps, np.arange(len(stamps)), rows))
    for finger in FINGERS:
        fields = [field for field in recording.fields if field.finger == finger]
        if fields:
            blocks.append(_markers(writer, finger, fields))
    return blocks


def _markers(writer: McapWriter, finger: Finger, fields: Sequence[MarkerField]) -> Block:
    stamps = to_ns([field.t_s for field in fields])
    markers = MarkerRows(
        np.stack([field.position_px for field in fields]),
        np.stack([field.displacement_px for field in fields]),
        np.stack([field.state for field in fields]),
        np.array([field.quality for field in fields], dtype=np.float64),
        np.array([field.residual_px for field in fields], dtype=np.float64),
    )
    topic = MARKER[finger]
    rows = pack_markers(stamps, markers, topic.frame_id)
    sequence = np.array([field.sequence for field in fields], dtype=np.int64)
    return message_rows(writer.channel[topic.name], stamps, sequence, rows)


def _scene(writer: McapWriter, pictures: Sequence[ScenePicture], keep: KeepFrames) -> list[Block]:
    if not pictures:
        return []
    stamps = to_ns([picture.t_s for picture in pictures]).tolist()
    messages = (
        pack_image(stamp, SCENE.frame_id, ENCODING[keep], encode(picture.image, keep))
        for stamp, picture in zip(stamps, pictures, strict=True)
    )
    channel = writer.channel[SCENE.name]
    return [message_list(channel, stamps, range(len(stamps)), messages)]


def _images(writer: McapWriter, frames: Sequence[TactileFrame], keep: KeepFrames) -> list[Block]:
    blocks = []
    for finger in FINGERS:
        mine = [frame for frame in frames if frame.finger == finger]
        topic, stamps = IMAGE[finger], to_ns([frame.t_s for frame in mine]).tolist()
        messages = (
            pack_image(stamp, topic.frame_id, ENCODING[keep], encode(frame.image, keep))
            for stamp, frame in zip(stamps, mine, strict=True)
        )
        sequence = [frame.sequence for frame in mine]
        if mine:
            channel = writer.channel[topic.name]
            blocks.append(message_list(channel, stamps, sequence, messages))
    return blocks
