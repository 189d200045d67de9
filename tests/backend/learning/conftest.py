"""Episodes of the pot with an effect that a small network learns at once."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.episodes import PackedEpisode, patch_hex, write_packs
from touchdown.backend.geometry import Piece, face_points, load_pieces


@pytest.fixture
def pot() -> Piece:
    return load_pieces().piece("pot")


@pytest.fixture
def write_data(pot: Piece) -> Callable[[Path, int], Path]:
    """Write episodes whose torque tells which half of the pot's face is in contact."""
    points = face_points(pot.face)

    def rows(count: int) -> Iterator[PackedEpisode]:
        rng = np.random.default_rng(6)
        for i in range(count):
            side = 1.0 if i % 3 else -1.0
            observation = rng.normal(size=(20, 258)).astype(np.float32)
            observation[:, 256] += np.float32(8 * side)
            label = {
                "episode": f"e{i}", "x_um": 0, "y_um": 0, "sigma_um": 0, "source": "commanded",
                "piece": pot.name, "bottom": ("circle15", "short")[i % 2],
                "patch": patch_hex(points[:, 0] * side >= 0), "points": len(points),
                "geometry": pot.sha256, "grip_id": f"g{i // 3}", "mounting_id": f"m{i // 6}",
                "person": "simulated", "seed": i,
            }  # fmt: skip
            yield PackedEpisode(observation, label)

    def write(folder: Path, count: int = 24) -> Path:
        write_packs(folder, "w", rows(count), {"test": "yes"})
        return folder

    return write
