"""Episode files: one episode in one MCAP file with its signals, images, label and metadata.

``read_compressed_episode`` leaves the images compressed until they are shown. ``salvage_file``
recovers the complete chunks of an incomplete file.
"""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from touchdown.backend import core
from touchdown.backend.config import TICK_S, BenchDescription
from touchdown.backend.episodes.mcap_container import (
    DAMAGE,
    DAMAGED_FILE_FIX,
    MAGIC,
    START_KEY,
    ChunkContents,
    McapWriter,
    MessageBlock,
    Opcode,
    check_counts,
    input_errors,
    iter_records,
    message_list,
    read_bytes,
    read_chunk_records,
    read_metadata,
    read_text,
    read_whole,
)
from touchdown.backend.episodes.messages import (
    BELIEF_TOPIC,
    CAMERA_TOPICS,
    COMMAND_TOPIC,
    EVENT_TOPIC,
    GEL_DEPTH_MM,
    HAND_FRAME,
    IMAGE_TOPICS,
    LABEL_TOPIC,
    MARKER_TOPICS,
    OBSERVATION_TOPIC,
    POINT_TOPICS,
    POSE_TOPIC,
    SCENE_TOPIC,
    STATIC_TOPIC,
    TACTILE_PX,
    TF_TOPIC,
    WRENCH_TOPIC,
    MarkerRows,
    Times,
    Topic,
    Transform,
    pack_camera,
    pack_hand,
    pack_image,
    pack_json,
    pack_markers,
    pack_observation,
    pack_points,
    pack_pose,
    pack_transforms,
    pack_wrench,
    schema_text,
    stamps_ns,
    unpack_image,
    unpack_markers,
    unpack_observation,
    unpack_pose_mm,
    unpack_wrench,
)
from touchdown.backend.sensing import Homography, locate_camera

KeepFrames = Literal["jpeg95_444", "png", "none"]
ENCODING: dict[KeepFrames, str] = {"jpeg95_444": "jpeg", "png": "png"}
MAX_PIXELS = 4096 * 4096
_JPEG = [
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def encode_image(image: core.ImageArray, keep: KeepFrames) -> bytes:
    """Compress a (h, w, 3) BGR image; raises ``ValueError`` if that fails."""
    suffix, options = (".png", _PNG) if keep == "png" else (".jpg", _JPEG)
    done, data = cv2.imencode(suffix, image, options)
    if not done:
        raise ValueError("the image could not be compressed")
    return data.tobytes()


def decode_image(data: bytes) -> core.ImageArray:
    """Decompress to (h, w, 3) BGR; raises ``ValueError`` if the data are not an image."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise ValueError("a stored image is damaged") from error
    if image is None or image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise ValueError("a stored image is damaged")
    return image.astype(np.uint8, copy=False)


FACTS_KEY = "facts"  # record ``bench``: description of the bench as JSON
PADS_KEY = "pad_distance_mm"  # pair: distance of the pads, the width of the held piece
HOMOGRAPHY_KEY = "scene_homography"  # pair: board mm to px of the scene camera
# Left: u along x, v down, seen along y; right: u against x, seen against y.
_HALF = math.sqrt(0.5)
_GEL_ROTATIONS = ((-_HALF, 0.0, 0.0, _HALF), (0.0, -_HALF, _HALF, 0.0))


class Frames(NamedTuple):
    """Constant transforms, and size (width, height) and focal length in px of cameras by frame."""

    static: list[Transform]
    cameras: dict[str, tuple[tuple[int, int], float]]


def make_frames(facts: str, pairs: Mapping[str, str], scene_px: tuple[int, int]) -> Frames:
    """Return the frames as far as they are known.

    ``base`` of the arm positions, ``hand`` at the grasp pivot, ``ft`` at the wrist sensor, cameras
    (x right, y down in the picture as stored; a tactile one is exact in the plane of its pad).
    ``facts``: ``BenchDescription`` as JSON; ``pairs``: of an episode; ``scene_px``: width, height.
    """
    bench, frames = BenchDescription.model_validate_json(facts), Frames([], {})
    if bench.sensor_height_mm is not None:
        turned = bench.ft_frame.partition(", turned ")[2].removesuffix(" rad")
        half_rad = 0.5 * float(turned or 0.0)
        turn = (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
        at_mm = (0.0, 0.0, bench.sensor_height_mm)
        frames.static.append(Transform(HAND_FRAME, WRENCH_TOPIC.frame_id, at_mm, turn))
    if bench.mm_per_px is not None and PADS_KEY in pairs:
        y_mm = 0.5 * float(pairs[PADS_KEY]) - GEL_DEPTH_MM
        for k, finger in enumerate(core.FINGERS):
            frame, at_mm = IMAGE_TOPICS[finger].frame_id, (0.0, (y_mm, -y_mm)[k], 0.0)
            frames.static.append(Transform(HAND_FRAME, frame, at_mm, _GEL_ROTATIONS[k]))
            frames.cameras[frame] = TACTILE_PX, GEL_DEPTH_MM / bench.mm_per_px[k]
    board = Homography.parse(pairs[HOMOGRAPHY_KEY]) if any(scene_px) else None
    if board is not None and (seen := locate_camera(board, scene_px)) is not None:
        focal_px, axes, eye_mm = seen
        vector = core.rotation_vector(axes)
        half_rad = 0.5 * float(np.linalg.norm(vector))
        rotation = [*(0.5 * np.sinc(half_rad / np.pi) * vector), math.cos(half_rad)]
        frame = SCENE_TOPIC.frame_id
        frames.static.append(Transform(POSE_TOPIC.frame_id, frame, eye_mm.tolist(), rotation))
        frames.cameras[frame] = scene_px, focal_px
    return frames


StampedMessages = tuple[Topic, Times, Times, Iterable[bytes]]
SCHEMA_VERSION = "1"
REST_KEY = "rest"  # pair of an episode that was recorded at rest, without a press
TOPICS = (
    OBSERVATION_TOPIC,
    LABEL_TOPIC,
    EVENT_TOPIC,
    WRENCH_TOPIC,
    POSE_TOPIC,
    COMMAND_TOPIC,
    *MARKER_TOPICS.values(),
    *IMAGE_TOPICS.values(),
)
LIVE_TOPICS = (*TOPICS[2:], TF_TOPIC, STATIC_TOPIC, BELIEF_TOPIC, *POINT_TOPICS.values(),
               *(CAMERA_TOPICS[topic.frame_id] for topic in IMAGE_TOPICS.values()))  # fmt: skip


def to_ns(t_s: ArrayLike) -> Times:
    """Convert bench seconds to integer ns."""
    ns: Times = np.rint(np.asarray(t_s, dtype=np.float64) * 1e9).astype(np.int64)
    return ns


def write_episode(
    path: Path,
    episode: core.Episode,
    label: Mapping[str, object] | None,
    metadata: Mapping[str, str],
    keep_frames: KeepFrames = "jpeg95_444",
) -> None:
    """Write ``episode`` to ``path``; the file is complete and durable, or does not exist.

    Headers hold the bench clock, in ns. Log times are on the wall clock: the bench clock plus
    ``START_KEY`` of ``metadata``, which becomes the record ``bench``.
    Markers and wrench are stored losslessly, images according to ``keep_frames``. Raises
    ``OSError`` if the disk fails; the episode can then be written again.
    """
    recording, topics, frames, width, height = episode.recording, TOPICS, None, 0, 0
    if recording is not None and recording.scene:
        topics = (*topics, SCENE_TOPIC)
        height, width = recording.scene[0].image.shape[:2]
    if recording is not None and FACTS_KEY in metadata:
        frames = make_frames(metadata[FACTS_KEY], dict(episode.metadata), (width, height))
        cameras = (CAMERA_TOPICS[frame] for frame in frames.cameras)
        topics = (*topics, TF_TOPIC, STATIC_TOPIC, *POINT_TOPICS.values(), *cameras)
    with McapWriter(path, topics) as writer:
        writer.start_ns = int(metadata.get(START_KEY, 0))
        for name, values in _metadata(episode, metadata, keep_frames).items():
            writer.add_metadata(name, values)
        blocks = [writer.block(*part) for part in _notes(episode, label)]
        if recording is not None:
            blocks += [writer.block(*part) for part in recording_messages(recording, frames)]
        writer.add_chunk(blocks, compress=True)
        if recording is not None and keep_frames != "none":
            images = [writer.block(*part) for part in image_messages(recording, keep_frames)]
            if images:
                writer.add_chunk(images, compress=False)
        check_counts(writer.part, writer.finish())


def _metadata(
    episode: core.Episode, metadata: Mapping[str, str], keep: KeepFrames
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
        "clock": {"utc_minus_monotonic_ns": metadata.get(START_KEY, "0"), "method": "bench clock"},
        "software": {"schema_version": SCHEMA_VERSION, "program": core.program_stamp()},
        "pairs": {"items": json.dumps(episode.metadata)},
    }


def _notes(episode: core.Episode, label: Mapping[str, object] | None) -> Iterator[StampedMessages]:
    steps = np.arange(len(episode.observation))
    stamps = to_ns(episode.onset_s + TICK_S * (steps + 1))
    yield OBSERVATION_TOPIC, stamps, steps, pack_observation(stamps, episode.observation)
    event = {"event": "contact", "t_s": episode.onset_s}
    for topic, note in ((EVENT_TOPIC, event), (LABEL_TOPIC, label)):
        if note is not None:
            yield topic, to_ns([episode.onset_s]), np.zeros(1, np.int64), [pack_json(note)]


def recording_messages(
    recording: core.Recording, frames: Frames | None
) -> Iterator[StampedMessages]:
    """Yield topic, stamps in ns, sequence numbers and messages of the signals without images.

    ``frames``: also transforms, cameras and marker clouds.
    """
    hand = () if frames is None else ((TF_TOPIC, recording.pose_t_s, pack_hand, recording.pose_mm),)
    for topic, t_s, pack, values in (
        (WRENCH_TOPIC, recording.wrench_t_s, pack_wrench, recording.wrench),
        (POSE_TOPIC, recording.pose_t_s, pack_pose, recording.pose_mm),
        (COMMAND_TOPIC, recording.command_t_s, pack_pose, recording.command_mm),
        *hand,
    ):
        if len(t_s):
            yield topic, to_ns(t_s), np.arange(len(t_s)), pack(to_ns(t_s), values)
    if frames is not None and len(recording.pose_t_s):
        start, first = to_ns(recording.pose_t_s[:1]), np.zeros(1, np.int64)
        yield STATIC_TOPIC, start, first, [pack_transforms(int(start[0]), frames.static)]
        for frame, (size_px, focal_px) in frames.cameras.items():
            message = pack_camera(int(start[0]), frame, size_px, focal_px)
            yield CAMERA_TOPICS[frame], start, first, [message]
    for finger in core.FINGERS:
        fields = [field for field in recording.fields if field.finger == finger]
        if not fields:
            continue
        stamps, frame = to_ns([field.t_s for field in fields]), MARKER_TOPICS[finger].frame_id
        sequence = np.array([field.sequence for field in fields], dtype=np.int64)
        markers = MarkerRows(
            np.stack([field.position_px for field in fields]),
            np.stack([field.displacement_px for field in fields]),
            np.stack([field.state for field in fields]),
            np.array([field.quality for field in fields], dtype=np.float64),
            np.array([field.residual_px for field in fields], dtype=np.float64),
        )
        yield MARKER_TOPICS[finger], stamps, sequence, pack_markers(stamps, markers, frame)
        if frames is not None and frame in frames.cameras:
            cloud = pack_points(stamps, markers, frame, GEL_DEPTH_MM / frames.cameras[frame][1])
            yield POINT_TOPICS[finger], stamps, sequence, cloud


def image_messages(recording: core.Recording, keep: KeepFrames) -> Iterator[StampedMessages]:
    """Yield the images like ``recording_messages``; each is encoded when it is taken."""
    scene = [core.TactileFrame("left", i, p.t_s, p.image) for i, p in enumerate(recording.scene)]
    for topic, frames in (
        *((IMAGE_TOPICS[f], [p for p in recording.frames if p.finger == f]) for f in core.FINGERS),
        (SCENE_TOPIC, scene),
    ):
        stamps = to_ns([frame.t_s for frame in frames])
        messages = (
            pack_image(int(stamp), topic.frame_id, ENCODING[keep], encode_image(frame.image, keep))
            for stamp, frame in zip(stamps, frames, strict=True)
        )
        if frames:
            yield topic, stamps, np.array([frame.sequence for frame in frames]), messages


def to_s(ns: Times) -> core.FloatArray:
    """Convert ns to bench seconds; whole microseconds are exact."""
    whole_us = ns % 1000 == 0
    return np.where(whole_us, (ns // 1000) * 1e-6, ns * 1e-9).astype(np.float64)


def read_episode(path: Path) -> core.Episode:
    """Read an episode file with decoded frames.

    Parameters
    ----------
    path : Path
        Episode file (``.mcap``).

    Returns
    -------
    Episode
        Observation (20, 258) and the recorded signals in their native rates and units: N and N·m,
        mm, px, seconds of the bench clock.

    Raises
    ------
    InputError
        If the file is damaged, is not an episode, or is a pack.

    """
    return episode_of(read_whole(path), path)


def episode_of(contents: ChunkContents, path: Path) -> core.Episode:
    """Return the episode of a file that was read; raises ``InputError`` if it is damaged."""
    if "pack" in contents.metadata:
        what = "The file is a pack of simulated episodes: no pictures were kept of them."
        fix = "Open them by the dataset that holds the pack."
        raise core.InputError(what, str(path), fix)
    if "episode" not in contents.metadata:
        raise core.InputError("The file holds no single episode.", str(path), DAMAGED_FILE_FIX)
    with input_errors(path):
        return _episode(contents)


def _episode(contents: ChunkContents) -> core.Episode:
    facts = contents.metadata["episode"]
    observation = unpack_observation(contents.messages[OBSERVATION_TOPIC.name])
    quality = core.parse_json(facts["quality"])
    quality["reasons"] = tuple(quality["reasons"])
    pairs = core.parse_json(contents.metadata["pairs"]["items"])
    return core.Episode(
        episode_id=facts["uuid"],
        piece=facts["grasped_piece"],
        observation=observation,
        offset_mm=np.array(core.parse_json(facts["offset_mm"]), dtype=np.float64).reshape(2),
        onset_s=float(core.parse_json(facts["onset_s"])),
        quality=core.EpisodeQuality(**quality),
        recording=_recording(contents) if facts["recording"] == "native" else None,
        metadata=tuple((str(key), str(value)) for key, value in pairs),
    )


def _recording(contents: ChunkContents) -> core.Recording:
    topics = (WRENCH_TOPIC, POSE_TOPIC, COMMAND_TOPIC)
    wrench, pose, command = (contents.messages.get(topic.name, []) for topic in topics)
    fields = [field for finger in core.FINGERS for field in _fields(contents, finger)]
    frames = [
        core.TactileFrame(finger, number, t_s, image)
        for finger in core.FINGERS
        for number, t_s, image in _pictures(contents, IMAGE_TOPICS[finger])
    ]
    scene = (core.ScenePicture(t_s, image) for _, t_s, image in _pictures(contents, SCENE_TOPIC))
    tare = core.parse_json(contents.metadata["calibration"]["tare"])
    return core.Recording(
        wrench_t_s=to_s(stamps_ns(wrench)),
        wrench=unpack_wrench(wrench),
        fields=tuple(sorted(fields, key=lambda field: field.t_s)),
        frames=tuple(sorted(frames, key=lambda frame: frame.t_s)),
        pose_t_s=to_s(stamps_ns(pose)),
        pose_mm=unpack_pose_mm(pose),
        scene=tuple(scene),
        tare=np.array(tare, dtype=np.float64).reshape(core.WRENCH_CHANNELS),
        command_t_s=to_s(stamps_ns(command)),
        command_mm=unpack_pose_mm(command),
    )


def _fields(contents: ChunkContents, finger: core.Finger) -> list[core.MarkerField]:
    topic = MARKER_TOPICS[finger].name
    messages = contents.messages.get(topic, [])
    rows, t_s = unpack_markers(messages), to_s(stamps_ns(messages))
    return [
        core.MarkerField(
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


def _pictures(
    contents: ChunkContents, topic: Topic
) -> Iterator[tuple[int, float, core.ImageArray]]:
    messages = contents.messages.get(topic.name, [])
    numbers = contents.sequence.get(topic.name, [])
    for number, t_s, message in zip(numbers, to_s(stamps_ns(messages)), messages, strict=True):
        yield number, float(t_s), decode_image(unpack_image(message)[1])


@dataclass(frozen=True, slots=True)
class CompressedImages:
    """Compressed images of one finger in order of time; ``t_s`` (n,) on the bench clock."""

    t_s: core.FloatArray
    packed: tuple[bytes, ...]

    def picture(self, index: int) -> core.ImageArray:
        """Decode image ``index`` to (h, w, 3) BGR; raises ``ValueError`` if it is damaged."""
        return decode_image(self.packed[index])


@dataclass(frozen=True, slots=True)
class CompressedEpisode:
    """``episode`` without frames, and the compressed images of each finger."""

    episode: core.Episode
    pictures: Mapping[core.Finger, CompressedImages]

    @property
    def bytes(self) -> int:
        """Size of the images in memory."""
        return sum(len(data) for film in self.pictures.values() for data in film.packed)


def without_images(episode: core.Episode) -> CompressedEpisode:
    """Return an episode recorded without images."""
    none = CompressedImages(np.zeros(0), ())
    return CompressedEpisode(episode, dict.fromkeys(core.FINGERS, none))


def read_compressed_episode(path: Path) -> CompressedEpisode:
    """Read the episode ``path``; raises ``InputError`` if it is damaged or foreign."""
    contents = read_whole(path)
    with input_errors(path):
        pictures = {}
        for finger in core.FINGERS:
            messages = contents.messages.pop(IMAGE_TOPICS[finger].name, [])
            contents.sequence.pop(IMAGE_TOPICS[finger].name, None)
            packed = tuple(bytes(unpack_image(message)[1]) for message in messages)
            pictures[finger] = CompressedImages(to_s(stamps_ns(messages)), packed)
    return CompressedEpisode(episode_of(contents, path), pictures)


@dataclass(frozen=True, slots=True)
class SalvageResult:
    """Result of a salvage: ``path`` is None if nothing was saved; ``reason``: end of reading."""

    path: Path | None
    chunks: int
    messages: dict[str, int]
    reason: str


@dataclass(slots=True)
class _ReadableHead:
    """Readable part of an incomplete file: channels, metadata and compressed chunks."""

    topics: list[Topic] = field(default_factory=list)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    chunks: list[tuple[list[MessageBlock], bool]] = field(default_factory=list)
    reason: str = "the file is complete"


def salvage_file(torn: Path, target: Path) -> SalvageResult:
    """Copy the complete chunks of ``torn`` into a new file ``target`` and verify it.

    Writes a report to ``<target>.json``. Raises ``OSError`` if the disk fails, or if the new file
    cannot be read back.
    """
    good = _read_good(torn)
    counts: dict[str, int] = {}
    path = None
    if good.chunks:
        counts = _write(good, target)
        path = target
    saved = SalvageResult(path, len(good.chunks), counts, good.reason)
    report = {"from": torn.name, "bytes": torn.stat().st_size, **asdict(saved)}
    report["path"] = path and path.name
    text = json.dumps(report, indent=1, sort_keys=True)
    core.write_atomically(target.with_name(f"{target.name}.json"), text.encode())
    return saved


def _read_good(torn: Path) -> _ReadableHead:
    good = _ReadableHead()
    try:
        data = read_bytes(torn)
        if not data.startswith(MAGIC):
            raise ValueError("it is not an MCAP file")
        for op, content in iter_records(memoryview(data)[len(MAGIC) :], "the file"):
            if op == Opcode.METADATA:
                good.metadata.append(read_metadata(content))
            elif op == Opcode.CHUNK:
                _take_chunk(content, good)
            elif op == Opcode.DATA_END:
                break
    except DAMAGE as error:
        good.reason = str(error)
    return good


def _take_chunk(content: memoryview, good: _ReadableHead) -> None:
    (crc,) = struct.unpack_from("<I", content, 24)
    if not crc:
        raise ValueError("a chunk has no checksum")
    plain = read_chunk_records(content)
    topics = list(_topics(plain))
    if len({topic.name for topic in topics}) != len(topics):
        raise ValueError("two channels of a chunk have one name")
    if good.topics and topics != good.topics:
        raise ValueError("a chunk belongs to another file")
    good.topics = topics
    blocks = _blocks(plain, len(topics))
    if blocks:
        good.chunks.append((blocks, read_text(content, 28)[0] == "zstd"))


def _topics(plain: bytes) -> Iterator[Topic]:
    schemas: dict[int, str] = {}
    expected = 1
    for op, content in iter_records(plain, "a chunk"):
        if op == Opcode.SCHEMA:
            number, name = struct.unpack_from("<H", content)[0], read_text(content, 2)[0]
            schemas[number] = name
            try:
                schema_text(name)
            except OSError as error:
                raise ValueError(f"unknown message type '{name[:60]}'") from error
        elif op == Opcode.CHANNEL:
            channel, schema = struct.unpack_from("<HH", content)
            if channel != expected:
                raise ValueError("the channels of a chunk are not those of an episode")
            expected += 1
            yield Topic(read_text(content, 4)[0], schemas[schema])


def _blocks(plain: bytes, channels: int) -> list[MessageBlock]:
    """Return the messages, one block per channel, in file order within each block."""
    messages: dict[int, list[tuple[int, int, bytes]]] = {}
    for op, content in iter_records(plain, "a chunk"):
        if op == Opcode.MESSAGE:
            channel, sequence, log_ns = struct.unpack_from("<HIQ", content)
            if not 0 < channel <= channels:
                raise ValueError("a message belongs to no channel")
            messages.setdefault(channel, []).append((log_ns, sequence, bytes(content[22:])))
    return [message_list(channel, *zip(*rows, strict=True)) for channel, rows in messages.items()]


def _write(good: _ReadableHead, target: Path) -> dict[str, int]:
    with McapWriter(target, good.topics) as writer:
        for name, values in good.metadata:
            writer.add_metadata(name, values)
        for blocks, compressed in good.chunks:
            writer.add_chunk(blocks, compress=compressed)
    check_counts(target, writer.counts)
    return {topic: count for topic, count in writer.counts.items() if count}
