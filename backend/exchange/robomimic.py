"""robomimic HDF5: one group per episode, actions within -1 to 1, our split as masks.

Source: ARISE-Initiative/robomimic, docs/datasets/overview.md and robomimic/utils/dataset.py. Labels
are datasets of each demo (``label_offset_mm``, ``label_patch``), ids its attributes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backend.config.method import SAMPLES_PER_PROBE
from backend.exchange.exporting import Job
from backend.exchange.extra import need
from backend.exchange.features import ACTION, DEMOS, FPS, OFFSET, PATCH, PICTURES, Feature
from backend.exchange.low_dim import ExportEpisode
from backend.exchange.patient_file import PatientFile

GYM = 2
ENVIRONMENT = "Touchdown"
ACTION_SIZE = 7


def write(job: Job, folder: Path) -> Mapping[str, object]:
    """Write the episodes of ``job`` to ``demos.hdf5`` in ``folder``."""
    h5py = need("h5py")
    with PatientFile(folder / DEMOS) as disk:
        with h5py.File(disk, "w") as file:
            scale = _write_all(file, job, disk)
        disk.check()
    return {"data": "hdf5", "action_scale": scale}


def _write_all(file: Any, job: Job, disk: PatientFile) -> float:
    """Write all demos and masks; returns the scale of the actions. Raises ``OSError``."""
    greatest = 0.0
    sides: dict[str, list[str]] = {}
    data = file.create_group("data")
    for episode in job.episodes():
        one = episode.chosen
        name = f"demo_{one.index}"
        action = _write_demo(data.create_group(name), episode, job.features)
        greatest = max(greatest, float(np.abs(action).max()))
        sides.setdefault(one.split, []).append(name)
        disk.check()
    scale = action_scale(greatest)
    if scale != 1.0:
        for demo in data.values():
            demo["actions"][...] = demo["actions"][...] / np.float32(scale)
    data.attrs["total"] = SAMPLES_PER_PROBE * len(job.chosen)
    kwargs = {"action_scale": scale, "fps": FPS}
    environment = {"env_name": ENVIRONMENT, "env_type": GYM, "env_kwargs": kwargs}
    data.attrs["env_args"] = json.dumps(environment)
    masks = file.create_group("mask")
    for side, names in sides.items():
        masks.create_dataset(side, data=np.array(names, dtype="S"))
    return scale


def action_scale(greatest: float) -> float:
    """Return the power of two that brings actions up to ``greatest`` within -1 to 1.

    Dividing by a power of two loses no bit.
    """
    return 2.0 ** max(0, int(np.ceil(np.log2(greatest)))) if greatest > 1.0 else 1.0


def _write_demo(
    demo: Any, episode: ExportEpisode, features: tuple[Feature, ...]
) -> NDArray[np.float32]:
    demo.attrs["num_samples"] = SAMPLES_PER_PROBE
    demo.attrs["product_episode"] = episode.chosen.entry.uuid
    demo.attrs["product_rev"] = episode.chosen.revision.rev_uuid
    action = np.zeros((SAMPLES_PER_PROBE, ACTION_SIZE), dtype=np.float32)
    for feature in features:
        if feature.key == ACTION:
            action = episode.values[ACTION]
        elif feature.key in (OFFSET, PATCH):
            _dataset(demo, feature.key.replace(".", "_"), episode.per_tick(feature))
        else:
            _observation(demo, feature.key, episode.values[feature.key])
    for key in PICTURES.values():
        if key in episode.pictures:
            _observation(demo, key, np.stack(episode.pictures[key]))
    dones = np.zeros(SAMPLES_PER_PROBE, dtype=np.int64)
    dones[-1] = 1
    _dataset(demo, "actions", action)
    _dataset(demo, "rewards", np.zeros(SAMPLES_PER_PROBE, dtype=np.float32))
    _dataset(demo, "dones", dones)
    _dataset(demo, "states", np.zeros((SAMPLES_PER_PROBE, 1), dtype=np.float32))
    return action


def _observation(demo: Any, key: str, values: NDArray[Any]) -> None:
    name = key.removeprefix("observation.images.").removeprefix("observation.")
    _dataset(demo, f"obs/{name}", values)
    _dataset(demo, f"next_obs/{name}", np.concatenate([values[1:], values[-1:]]))


def _dataset(demo: Any, name: str, values: NDArray[Any]) -> None:
    # Chunks of one episode, so that a reader may take some ticks of a picture without the rest.
    demo.create_dataset(name, data=values, compression=1 if values.ndim > 2 else None)
