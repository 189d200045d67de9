"""A small dataset with recordings, pictures, several grips and labels in every state."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.backend.annotations.conftest import context_for
from touchdown.backend.annotations import Dataset, Label, uuid7
from touchdown.backend.bench import make_scene
from touchdown.backend.config import SimulationSettings
from touchdown.backend.config.bench_description import describe_simulation
from touchdown.backend.core.values import (
    FINGERS,
    MARKERS,
    Episode,
    EpisodeQuality,
    MarkerField,
    Recording,
    ScenePicture,
    TactileFrame,
)
from touchdown.backend.episodes import FACTS_KEY, HOMOGRAPHY_KEY, PADS_KEY
from touchdown.backend.exchange.exports import ExportResult, Video, export
from touchdown.backend.geometry import load_pieces
from touchdown.backend.runs import SceneChoice
from touchdown.backend.sensing import Homography
from touchdown.backend.simulation.scene_camera import camera_matrix, render_scene

EVERY = ("approved", "submitted", "draft")
GOOD = EpisodeQuality(True, (), 0, 0.0, 0, 5.0, 0.0)
BOARD = camera_matrix()[:, [0, 1, 3]] / camera_matrix()[2, 3]  # board mm to px
Hand = Callable[..., ExportResult]


def picture(rng: np.random.Generator) -> np.ndarray:
    """A smooth picture with round dots, as a gel looks: coarse noise enlarged."""
    coarse = rng.integers(60, 200, (8, 10, 3)).astype(np.uint8)
    return np.ascontiguousarray(coarse.repeat(30, axis=0).repeat(32, axis=1))


def recorded_episode(seed: int, frames: bool = True, commands: bool = True) -> Episode:
    rng = np.random.default_rng(seed)
    onset_s = 1.25 + seed / 1e4 + 1e-7
    wrench_t_s = np.round(0.9 + 0.001 * np.arange(2600), 6) + seed / 1e4
    pose_t_s = np.round(0.9 + 0.01 * np.arange(260), 6) + seed / 1e4
    films = [
        TactileFrame(finger, k, 1.0 + 0.1 * k + seed / 1e4, picture(rng))
        for k in range(24)
        for finger in FINGERS
    ]
    recording = Recording(
        wrench_t_s, rng.normal(size=(2600, 6)), (), tuple(films) if frames else (), pose_t_s,
        rng.normal(scale=20.0, size=(260, 3)), np.zeros(6),
    )  # fmt: skip
    observation = rng.normal(size=(20, 258)).astype(np.float32)
    if commands:
        told_mm = rng.normal(scale=20.0, size=(260, 3))
        recording = replace(recording, command_t_s=pose_t_s.copy(), command_mm=told_mm)
    return Episode(uuid7(), "pot", observation, np.zeros(2), onset_s, GOOD, recording)


def seen_episode(seed: int) -> Episode:
    """An episode of the simulated bench's description with scene pictures and marker fields."""
    episode, rng = recorded_episode(seed), np.random.default_rng(seed)
    fields = tuple(
        MarkerField(frame.finger, frame.sequence, frame.t_s, rng.uniform(5, 235, (MARKERS, 2)),
                    rng.normal(size=(MARKERS, 2)), rng.integers(0, 3, MARKERS).astype(np.uint8), 1)
        for frame in episode.recording.frames
    )  # fmt: skip
    choice = SceneChoice("pot", ("circle15",), 3, jig=True)
    scene = make_scene(load_pieces(), choice, SimulationSettings())
    pictures = tuple(
        ScenePicture(episode.onset_s + t_s, render_scene(scene, at, 0.0, 0.0))
        for t_s, at in ((0.5, (-2.5, 0.0)), (3.0, (30.0, 0.0)))
    )
    pairs = ((HOMOGRAPHY_KEY, Homography(BOARD, 0.0).text()), (PADS_KEY, "30"))
    recording = replace(episode.recording, fields=fields, scene=pictures)
    return replace(episode, recording=recording, metadata=pairs)


@pytest.fixture
def seen(tmp_path: Path) -> Iterator[Dataset]:
    with Dataset.open(tmp_path / "seen", person="cleo") as opened:
        facts = describe_simulation(SimulationSettings()).model_dump_json()
        context = replace(context_for(opened), bench={FACTS_KEY: facts})
        for k in range(2):
            label = Label(1000 * k - 2501, 137 * k, 12 * k, 150)
            opened.record(seen_episode(k), label, source="measured", context=context)
        yield opened


def fill(dataset: Dataset, count: int = 6, frames: bool = True) -> list[str]:
    """Two episodes per grip; cleo records, ann submits all but the last, bob approves four."""
    context = context_for(dataset)
    made = []
    for k in range(count):
        grip = replace(context, grip_id=f"grip-{k // 2}", mounting_id="mounting-1")
        label = Label(1000 * k - 2501, 137 * k, 12 * k, 150)
        entry = dataset.record(recorded_episode(k, frames), label, source="measured", context=grip)
        made.append(entry.uuid)
    for uuid in made[:-1]:
        dataset.labels.accept("ann", uuid)
    for uuid in made[:4]:
        dataset.labels.approve("bob", uuid)
    return made


@pytest.fixture(scope="session")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("filled") / "data"
    with Dataset.open(folder, person="cleo") as opened:
        fill(opened)
    return folder


@pytest.fixture
def dataset(filled: Path, tmp_path: Path) -> Iterator[Dataset]:
    shutil.copytree(filled, tmp_path / "data")
    with Dataset.open(tmp_path / "data", person="cleo") as opened:
        yield opened


@pytest.fixture
def hand(dataset: Dataset, tmp_path: Path) -> Hand:
    """Export the dataset (or ``of``) to a new folder: as asked, or all labels with a split."""

    def make(
        name: str, out: str = "", of: Dataset | None = None, video: Video | None = "none",
        **asked: Any,
    ) -> ExportResult:  # fmt: skip
        wanted = asked or {"states": EVERY, "held_out": 0.4, "divide_series": True}
        return export(of or dataset, name, tmp_path / (out or name), video=video, **wanted)

    return make
