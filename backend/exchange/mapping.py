"""Mapping file of a foreign recording: its topics or features as signals of the bench.

``read`` and ``read_contents`` open foreign files and are called in a child process only.

Source of the frames: ``touchdown.backend.core.values``. A tactile picture of the bench has the hand
on top: a press moves the markers up, since the piece is pushed towards the hand.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from touchdown.backend.config import Positive, Settings, read_settings
from touchdown.backend.core import (
    FINGERS,
    GRID_COLS,
    GRID_ROWS,
    MARKERS,
    Finger,
    FloatArray,
    InputError,
    TactileFrame,
    require_package,
)
from touchdown.backend.episodes import decode_image
from touchdown.backend.exchange.features import ForeignEpisode, RecordedSignal
from touchdown.backend.exchange.lerobot_reader import read as read_lerobot
from touchdown.backend.exchange.lerobot_reader import read_info
from touchdown.backend.sensing import HEIGHT_PX, WIDTH_PX, resize_picture, track_frames

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
FORCE_N = {"N": 1.0, "mN": 1e-3, "lbf": 4.4482216, "kgf": 9.80665}
MOMENT_NM = {"N m": 1.0, "N mm": 1e-3, "lbf in": 0.1129848, "kgf m": 9.80665}
LENGTH_MM = {"m": 1e3, "mm": 1.0}
SIGNALS = ("wrench", "pose", *FINGERS)
GROUPS = ("unknown", "recording", "folder")  # one for the import, or for each of these
# Rest positions for a marker array that holds displacements only.
NOMINAL_PX = 32.0 * np.stack(np.divmod(np.arange(MARKERS), GRID_COLS)[::-1], -1) + (32.0, 24.0)

LEAST_LIKENESS = 0.9  # correlation of rest positions with these
MappingChange = tuple[str, str, Any]  # signal, field and value
VALUE = r"""("[^"]*"|'[^']*'|\[[^\]]*\]|[^\s#]+)"""  # of TOML, on one line
Samples = Iterable[tuple[int, NDArray[Any]]]  # time stamps in ns, with numbers or a BGR picture


class SignalSource(Settings):
    """Place of one signal: ``source`` is a topic of a bag or a feature of a data set.

    ``first``: index of its first number. ``stamp``: time in the header, or of the recorder.
    """

    source: Annotated[str, Field(min_length=1)]
    first: Annotated[int, Field(ge=0)] = 0
    stamp: Literal["header", "log"] = "header"
    time_offset_s: float = 0.0  # added to the time stamps

    def numbers(self, rows: list[NDArray[Any]], width: int) -> FloatArray:
        """Return (n, width) of the numbers from ``first`` on."""
        if len({row.size for row in rows}) > 1 or rows[0].size < self.first + width:
            raise InputError(
                f"'{self.source}' has {rows[0].size} numbers; {self.first + width} are needed.",
                self.source, "Correct 'source' or 'first' in the mapping.",
            )  # fmt: skip
        return np.array([row[self.first : self.first + width] for row in rows], float)


class _InSpace(SignalSource):
    """``axes``: the foreign axes along x, y and z of the bench."""

    axes: tuple[Axis, Axis, Axis]

    @model_validator(mode="after")
    def _is_right_handed(self) -> Self:
        if not np.isclose(np.linalg.det(self.rotation), 1.0):
            raise ValueError(f"axes {', '.join(self.axes)} are not a right-handed frame")
        return self

    @property
    def rotation(self) -> FloatArray:
        """(3, 3) matrix from the foreign axes to those of the bench."""
        return np.array([np.eye(3)["xyz".index(a[-1])] * (-1) ** (len(a) - 1) for a in self.axes])


class WrenchSource(_InSpace):
    """Force, then moment; ``acts_on`` the tool (as on the bench) or the environment.

    ``payload_kg``: mass below the sensor, of an untared wrench.
    """

    force_unit: Literal["N", "mN", "lbf", "kgf"]
    moment_unit: Literal["N m", "N mm", "lbf in", "kgf m"]
    acts_on: Literal["tool", "environment"]
    payload_kg: Positive | None = None

    def converted(self, rows: list[NDArray[Any]]) -> FloatArray:
        """Return (n, 6) in N and N·m, environment on the tool."""
        sign = 1.0 if self.acts_on == "tool" else -1.0
        units = np.array([[FORCE_N[self.force_unit]], [MOMENT_NM[self.moment_unit]]])
        parts = sign * units * self.numbers(rows, 6).reshape(-1, 2, 3)
        return np.asarray((parts @ self.rotation.T).reshape(-1, 6))


class PoseSource(_InSpace):
    """Position of the hand; ``origin_mm``: where the face lies centred on the bottom (x, y)."""

    unit: Literal["m", "mm"]
    origin_mm: tuple[float, float] | None = None

    def converted(self, rows: list[NDArray[Any]]) -> FloatArray:
        """Return (n, 3) in mm."""
        return np.asarray(LENGTH_MM[self.unit] * self.numbers(rows, 3) @ self.rotation.T)


class TactileSource(SignalSource):
    """Pictures of a gel, or arrays of its 63 markers row by row.

    ``turn_deg`` (counterclockwise) and then ``mirror`` make the picture look like the bench's.
    ``width_px``: width of the picture that an array in px refers to. ``order``: u and v of each
    marker in turn, or all u before all v.
    """

    kind: Literal["images", "positions", "displacements"]
    unit: Literal["px", "mm"] = "px"
    width_px: Positive = WIDTH_PX
    mm_per_px: Positive = 0.058
    order: Literal["pairs", "planes"] = "pairs"
    turn_deg: Literal[0, 90, 180, 270] = 0
    mirror: bool = False

    def turned(self, picture: NDArray[Any]) -> NDArray[Any]:
        """Return a picture (H, W, ...) or a grid (rows, columns, ...), turned and mirrored."""
        whole = np.rot90(picture, self.turn_deg // 90)
        return np.ascontiguousarray(whole[:, ::-1] if self.mirror else whole)

    def converted(self, rows: list[NDArray[Any]]) -> FloatArray:
        """Return marker positions (n, 63, 2) in px of the bench's picture, from arrays."""
        grid = (GRID_ROWS, GRID_COLS)[:: -1 if self.turn_deg in (90, 270) else 1]
        numbers = self.numbers(rows, 2 * MARKERS)
        if self.order == "planes":
            numbers = numbers.reshape(-1, 2, MARKERS).swapaxes(1, 2)
        # As complex numbers u + iv, a quarter turn counterclockwise is a factor of -i.
        scale = WIDTH_PX / self.width_px if self.unit == "px" else 1.0 / self.mm_per_px
        turn = scale * (-1j) ** (self.turn_deg // 90)
        moved = turn * (numbers.reshape(-1, *grid, 2) @ (1.0, 1.0j))
        moved = np.array([self.turned(one).ravel() for one in moved])
        found = np.stack([-moved.real if self.mirror else moved.real, moved.imag], axis=-1)
        if self.kind == "displacements":
            return np.asarray(found + NOMINAL_PX)
        with np.errstate(invalid="ignore"):
            likeness = [np.corrcoef(found[0, :, k], NOMINAL_PX[:, k])[0, 1] for k in range(2)]
        if not np.min(likeness) > LEAST_LIKENESS:
            what = f"The markers of '{self.source}' do not begin on a grid of 7 by 9."
            raise InputError(what, self.source, "Correct 'kind', 'first', 'order' or 'turn_deg'.")
        return np.asarray(found - found[0].mean(axis=0) + np.divide((WIDTH_PX, HEIGHT_PX), 2.0))


class GripSettings(Settings):
    """Grips and mountings: one of ``GROUPS``, or the topic or feature that holds their number."""

    grip: Annotated[str, Field(min_length=1)] = "unknown"
    mounting: Annotated[str, Field(min_length=1)] = "unknown"


class ImportMapping(Settings):
    """All signals of a recording, and the grips of its presses."""

    wrench: WrenchSource
    pose: PoseSource
    left: TactileSource
    right: TactileSource
    grips: GripSettings = GripSettings()

    @property
    def sources(self) -> dict[str, Any]:
        """Sources by name: the signals, and the numbers of grips and mountings."""
        numbers = {k: SignalSource(source=own) for k, own in self.grips if own not in GROUPS}
        return {name: getattr(self, name) for name in SIGNALS} | numbers


def map_signals(mapping: ImportMapping, samples: Mapping[str, Samples]) -> dict[str, NDArray[Any]]:
    """Return the signals of one recording in units and frames of the bench, from their samples.

    ``NAME.t_s`` (n,) from the first sample of any signal, s. ``wrench`` (n, 6), ``pose`` (n, 3) in
    mm; ``left``, ``right`` (n, 63, 2) in px, with ``.state``; ``grip``, ``mounting`` (n, 1).
    """
    values: dict[str, NDArray[Any]] = {}
    for name, source in mapping.sources.items():
        if isinstance(source, TactileSource) and source.kind == "images":
            pictures = _checked(source, samples[name], dimensions=3)
            frames = (
                TactileFrame(cast("Finger", name), number, 1e-9 * stamp_ns,
                             resize_picture(source.turned(picture), source.source))
                for number, (stamp_ns, picture) in enumerate(pictures)
            )  # fmt: skip
            fields = [one.field for one in track_frames(frames, None, source.source)]
            values[f"{name}.t_s"] = np.array([field.t_s for field in fields])
            values[name] = np.array([field.position_px for field in fields])
            values[f"{name}.state"] = np.array([field.state for field in fields])
            continue
        both = sorted(_checked(source, samples[name], dimensions=1), key=lambda one: one[0])
        if len(both) < 1 + (name in SIGNALS):
            what = f"There are {len(both)} messages or rows of '{source.source}'."
            raise InputError(what, source.source, "Correct this name in the mapping.")
        values[f"{name}.t_s"] = np.array([1e-9 * stamp_ns for stamp_ns, _ in both])
        numbers = [row for _, row in both]
        values[name] = source.converted(numbers) if name in SIGNALS else source.numbers(numbers, 1)
        if name in FINGERS:
            values[f"{name}.state"] = np.zeros(values[name].shape[:2], np.uint8)
    start_s = min(float(values[f"{name}.t_s"][0]) for name in mapping.sources)
    for name, source in mapping.sources.items():
        values[f"{name}.t_s"] += source.time_offset_s - start_s
    return values


def _checked(source: SignalSource, samples: Samples, dimensions: int) -> Samples:
    """Yield ``samples``; raises ``InputError`` for pictures instead of numbers, or the reverse."""
    for stamp_ns, value in samples:
        if value.ndim != dimensions:
            what = f"It has {'numbers' if value.ndim == 1 else 'pictures'} only."
            raise InputError(what, source.source, "Correct 'source' or 'kind' in the mapping.")
        yield stamp_ns, value


def read(kind: str, source: Path, mapping: Path) -> Iterator[ForeignEpisode]:
    """Yield the mapped signals of each episode of a data set, or of each bag."""
    signals = read_settings(ImportMapping, mapping)
    sources = signals.sources
    if kind == "lerobot":
        for episode in read_lerobot(source, [one.source for one in sources.values()]):
            samples = {name: _rows(episode, one.source) for name, one in sources.items()}
            yield replace(episode, values=map_signals(signals, samples), mounting=source.name,
                          grip=f"episode-{episode.index}")  # fmt: skip
        return
    for bag, own in _bags(source).items():
        messages = {name: read_messages(own, one) for name, one in sources.items()}
        # All have the number 0, so that a bag is known again without the others.
        grip, mounting = bag.name.removesuffix(".mcap"), bag.parent.name
        yield ForeignEpisode(0, 0.0, map_signals(signals, messages), grip=grip, mounting=mounting)


def _bags(source: Path) -> dict[Path, list[Path]]:
    """Return the files of each bag; those beside ``metadata.yaml`` are one bag, their folder."""
    bags: dict[Path, list[Path]] = {}
    found = filter(Path.is_file, source.rglob("*.mcap")) if source.is_dir() else [source]
    for file in sorted(found):
        whole = (file.parent / "metadata.yaml").is_file()
        bags.setdefault(file.parent if whole else file, []).append(file)
    if not bags:
        raise InputError("There is no MCAP file.", str(source), "Name a file or a bag of MCAP.")
    return bags


def recording_format(source: Path) -> str:
    """Return ``lerobot`` for the folder of a LeRobot data set, else ``mcap``."""
    return "lerobot" if (source / "meta/info.json").is_file() else "mcap"


def read_contents(source: Path) -> Iterator[ForeignEpisode]:
    """Yield one array of texts by name: a row for each signal, with a column for each field."""
    found = dict[str, RecordedSignal]()
    if recording_format(source) == "lerobot":
        info = read_info(source)
        for name, one in info["features"].items():
            numbers = 0 if one["dtype"] in FILMED else int(np.prod(one["shape"]))
            size = info["total_frames"], info["fps"]
            found[name] = RecordedSignal(name, one["dtype"], numbers, *size)
    else:
        for file in (file for bag in _bags(source).values() for file in bag):
            for topic in _topics(file):
                before = found[topic.name].messages if topic.name in found else 0
                found[topic.name] = topic._replace(messages=topic.messages + before)
    yield ForeignEpisode(0, 0.0, {"contents": np.array(sorted(found.values()))})


def _topics(bag: Path) -> Iterator[RecordedSignal]:
    """Yield the topics of one file by its index and their first messages."""
    decoders = [require_package("mcap_ros2.decoder").DecoderFactory()]
    with bag.open("rb") as stream:
        reader = require_package("mcap.reader").make_reader(stream, decoder_factories=decoders)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            fix = "The recorder was interrupted: write the file again with 'mcap recover'."
            raise InputError("The file has no index.", str(bag), fix)
        whole = summary.statistics
        span_s = max(1e-9 * (whole.message_end_time - whole.message_start_time), 1e-3)
        for number, channel in summary.channels.items():
            schema, topic = summary.schemas[channel.schema_id], channel.topic
            count, numbers = whole.channel_message_counts.get(number, 0), 0
            if count and not schema.name.endswith(FILMED):
                first = next(reader.iter_decoded_messages(topics=[topic]))
                numbers = len(list(_numbers(first.decoded_message)))
            yield RecordedSignal(topic, schema.name, numbers, count, count / span_s)


FILMED = ("Image", "image", "video")  # endings of types that hold pictures


def propose_mapping(contents: Sequence[RecordedSignal]) -> str:
    """Return a mapping file to correct, with units of ROS 2 and the sources that fit by name."""

    def source(numbers: int, *words: str, filmed: bool = False) -> RecordedSignal | None:
        """Return the signal with this size and the most of ``words`` in its name and type."""
        fitting = {
            one: sum(word in f"{one.name} {one.kind}".lower() for word in words)
            for one in contents
            if one.numbers >= numbers or (filmed and one.kind.endswith(FILMED))
        }
        return max((one for one in fitting if fitting[one]), key=fitting.__getitem__, default=None)

    found = {
        "wrench": source(6, "wrench", "force", "/ft", ".ft"),
        "pose": source(3, "pose", "transform", "state"),
    }
    for finger in FINGERS:
        found[finger] = source(2 * MARKERS, finger, f"gel_{finger}", f"tac_{finger}", filmed=True)
    arrays = {f"{name}_kind": "positions" if one and one.numbers else "images"
              for name, one in found.items()}  # fmt: skip
    text = files("touchdown.resources").joinpath("mapping.toml.in").read_text("utf-8")
    return text.format(**{name: one.name if one else "" for name, one in found.items()}, **arrays)


def correct_mapping(text: str, changes: Iterable[MappingChange]) -> str:
    """Return a mapping file with other values in its tables; all else stays."""
    for signal, name, value in changes:
        table = re.search(rf"^\[{signal}\].*?(?=^\[|\Z)", text, re.MULTILINE | re.DOTALL)
        if table is not None:
            line, own = f"{name} = {json.dumps(value)}", rf"^{name}\s*=\s*{VALUE}"
            if found := re.search(own, table[0], re.MULTILINE):
                body = f"{table[0][: found.start()]}{line}{table[0][found.end() :]}"
            else:
                body = table[0].replace("]", f"]\n{line}", 1)
            text = f"{text[: table.start()]}{body}{text[table.end() :]}"
    return text


def _rows(episode: ForeignEpisode, feature: str) -> Samples:
    for k, row in enumerate(episode.values.get(feature, ())):
        # Videos are RGB.
        yield round(1e9 * k / episode.fps), row[..., ::-1] if row.ndim == 3 else row.reshape(-1)


def read_messages(files: list[Path], signal: SignalSource) -> Samples:
    """Yield the messages of one topic of a bag."""
    make_reader = require_package("mcap.reader").make_reader
    factory = require_package("mcap_ros2.decoder").DecoderFactory
    for file in files:
        with file.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[factory()])
            for _, _, message, content in reader.iter_decoded_messages(topics=[signal.source]):
                stamp_ns = message.log_time
                if signal.stamp == "header" and hasattr(content, "header"):
                    stamp = content.header.stamp
                    stamp_ns = 1_000_000_000 * stamp.sec + stamp.nanosec
                yield stamp_ns, _value(content, signal.source)


DEPTHS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "mono8": 1, "8UC1": 1}  # bytes a pixel


def _value(content: Any, where: str) -> NDArray[Any]:
    """Return the BGR picture of an image message, or all numbers of another one, in order."""
    if hasattr(content, "format") and hasattr(content, "data"):
        return decode_image(bytes(content.data))
    if not (hasattr(content, "encoding") and hasattr(content, "step")):
        return np.array(list(_numbers(content)), np.float64)
    if content.encoding not in DEPTHS:
        fix = f"Convert it to one of: {', '.join(DEPTHS)}."
        raise InputError(f"Its pictures are in '{content.encoding}'.", where, fix)
    depth = DEPTHS[content.encoding]
    raw = np.frombuffer(content.data, np.uint8).reshape(content.height, content.step)
    picture = raw[:, : content.width * depth].reshape(content.height, content.width, depth)
    colours = np.broadcast_to(picture, (content.height, content.width, 3))
    return np.ascontiguousarray(colours[..., ::-1] if content.encoding == "rgb8" else colours)


def _numbers(value: Any) -> Iterator[float]:
    if hasattr(value, "__slots__"):  # a message
        for name in value.__slots__:
            if name not in ("header", "layout"):
                yield from _numbers(getattr(value, name))
    elif isinstance(value, int | float):
        yield float(value)
    elif not isinstance(value, str):
        for each in value:
            yield from _numbers(each)
