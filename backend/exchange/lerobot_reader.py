"""Reader of LeRobot datasets v3.0 and v2.1, used in a child process only."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import InputError, parse_json, require_package
from touchdown.backend.exchange.features import PICTURES, ForeignEpisode

VERSIONS = ("v3.0", "v2.1")
PREFIXES = ("observation.", "action", "label.")
MAX_JSON_BYTES = 100_000_000
MAX_TICKS = 100_000


def read(source: Path, wanted: Sequence[str] = ()) -> Iterator[ForeignEpisode]:
    """Yield the episodes by number, with the features ``wanted`` (default: those of an export)."""
    info = read_info(source)
    for name in wanted:
        kind, version = info["features"].get(name, {}).get("dtype"), info["codebase_version"]
        if kind == "image" or (kind == "video" and version != "v3.0"):
            what = f"'{name}' is '{kind}' in version {version}; only videos of v3.0 are read."
            fix = "Convert the dataset to v3.0 with videos, or map an array of the markers."
            raise InputError(what, str(source), fix)
    fps, sides = float(info["fps"]), info.get("splits", {})
    films = _VideoReader(source, info, wanted or tuple(PICTURES.values()))
    for path in sorted((source / "data").rglob("*.parquet")):
        for number, rows in _groups(path, info["features"], tuple(wanted) or PREFIXES):
            pictures = films.pictures(number)
            yield ForeignEpisode(number, fps, {**rows, **pictures}, _side(sides, number))


def read_info(source: Path) -> dict[str, Any]:
    """Return the description of a data set; raises ``InputError`` for an unknown version."""
    path = source / "meta/info.json"
    if not path.is_file() or path.stat().st_size > MAX_JSON_BYTES:
        fix = "Name the folder that holds meta/info.json."
        raise InputError("This is not a LeRobot dataset.", str(path), fix)
    info: dict[str, Any] = parse_json(path.read_bytes())
    version = info.get("codebase_version")
    if version not in VERSIONS:
        fix = f"Convert it to one of: {', '.join(VERSIONS)}."
        raise InputError(f"This is version {version} of LeRobot datasets.", str(path), fix)
    return info


def _side(sides: Mapping[str, str], number: int) -> str:
    """Return the side of an episode; "" if all are on one side."""
    if len(sides) < 2:
        return ""
    for side, span in sides.items():
        first, _, last = str(span).partition(":")
        if first.isdigit() and last.isdigit() and int(first) <= number < int(last):
            return str(side)
    return ""


def _groups(
    path: Path, features: Mapping[str, Any], wanted: tuple[str, ...]
) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
    """Yield (episode, rows); an episode lies within one file, in order."""
    file = require_package("pyarrow.parquet").ParquetFile(path)
    kept = [name for name in file.schema_arrow.names if name.startswith(wanted)]
    number, parts = -1, list[dict[str, NDArray[Any]]]()
    for group in range(file.num_row_groups):
        table = file.read_row_group(group, columns=[*{*kept, "episode_index"}])
        episodes = table.column("episode_index").to_numpy()
        for one in np.unique(episodes).tolist():
            if one != number and parts:
                yield number, _joined(parts)
                parts = []
            rows = table.filter(episodes == one)
            number = int(one)
            parts.append({k: _array(rows.column(k), features[k]) for k in kept})
    if parts:
        yield number, _joined(parts)


def _joined(parts: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if len(next(iter(joined.values()))) > MAX_TICKS:
        raise ValueError("an episode is longer than any probe")
    return joined


def _array(column: Any, feature: Mapping[str, Any]) -> NDArray[Any]:
    flat = column.combine_chunks()
    while hasattr(flat, "flatten") and hasattr(flat.type, "value_type"):
        flat = flat.flatten()
    shape = [] if feature["shape"] == [1] else list(feature["shape"])
    return np.asarray(flat.to_numpy(zero_copy_only=False)).reshape(len(column), *shape)


class _VideoReader:
    """Videos of a dataset v3.0, read at the positions in ``meta/episodes``."""

    def __init__(self, source: Path, info: Mapping[str, Any], wanted: Sequence[str]) -> None:
        self._source, self._info = source, info
        is_filmed = info.get("codebase_version") == "v3.0" and info.get("video_path")
        filmed = [k for k, one in info["features"].items() if one["dtype"] == "video"]
        self._keys = [k for k in wanted if is_filmed and k in filmed]
        self._rows: dict[int, dict[str, Any]] = {}
        if self._keys:
            for path in sorted((source / "meta/episodes").rglob("*.parquet")):
                for row in require_package("pyarrow.parquet").read_table(path).to_pylist():
                    self._rows[row["episode_index"]] = row

    def pictures(self, number: int) -> dict[str, NDArray[Any]]:
        """Return the images (T, h, w, 3) RGB per camera."""
        return {key: self._film(key, self._rows[number]) for key in self._keys}

    def _film(self, key: str, row: Mapping[str, Any]) -> NDArray[Any]:
        chunk, number = (row[f"videos/{key}/{name}_index"] for name in ("chunk", "file"))
        path = self._source / self._info["video_path"].format(
            video_key=key, chunk_index=chunk, file_index=number
        )
        if not path.resolve().is_relative_to(self._source.resolve()):
            raise ValueError(f"{path} lies outside the dataset")
        start_s, half_s = row[f"videos/{key}/from_timestamp"], 0.5 / float(self._info["fps"])
        pictures: list[NDArray[Any]] = []
        with require_package("av").open(str(path)) as container:
            stream = container.streams.video[0]
            container.seek(int(start_s / stream.time_base), stream=stream, backward=True)
            for frame in container.decode(stream):
                if frame.time >= start_s - half_s:
                    pictures.append(frame.to_ndarray(format="rgb24"))
                if len(pictures) == row["length"]:
                    break
        return np.stack(pictures)
