"""Reader of robomimic HDF5 files, used in a child process only."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import InputError, parse_json, require_package
from touchdown.backend.exchange import features

# Larger than any array of a probe: a damaged shape is not allocated.
MAX_VALUES = 50_000_000


def read(source: Path) -> Iterator[features.ForeignEpisode]:
    """Yield the demos by number."""
    path = source / features.DEMOS if source.is_dir() else source
    if not path.is_file():
        raise InputError("There is no such file.", str(path), "Name the HDF5 file.")
    with require_package("h5py").File(path, "r") as file:
        data = file["data"]
        kwargs = parse_json(data.attrs.get("env_args", "{}")).get("env_kwargs", {})
        sides = {
            name.decode(): side
            for side, names in file.get("mask", {}).items()
            for name in names[()].tolist()
        }
        numbers = sorted(int(name.removeprefix("demo_")) for name in data)
        for number in numbers:
            name = f"demo_{number}"
            yield features.ForeignEpisode(
                number,
                float(kwargs["fps"]) if "fps" in kwargs else None,
                _values(data[name], float(kwargs.get("action_scale", 1.0))),
                sides.get(name, ""),
                str(data[name].attrs.get("product_episode", "")),
            )


def _values(demo: Any, scale: float) -> dict[str, NDArray[Any]]:
    images = {key.removeprefix("observation.images."): key for key in features.PICTURES.values()}
    values = {
        images.get(name, f"observation.{name}"): _array(array)
        for name, array in demo["obs"].items()
    }
    actions = _array(demo["actions"])
    values[features.ACTION] = actions * np.asarray(scale, dtype=actions.dtype)
    for key in (features.OFFSET, features.PATCH):
        name = key.replace(".", "_")
        if name in demo:
            values[key] = _array(demo[name])
    return values


def _array(stored: Any) -> NDArray[Any]:
    if stored.size > MAX_VALUES:
        raise ValueError(f"{stored.name} has {stored.size} values")
    return np.asarray(stored[()])
