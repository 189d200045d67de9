"""Probes that a model learns in two epochs: the torque tells which half of the face touches."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from touchdown.backend.episodes import PackedEpisode, patch_hex, write_packs
from touchdown.backend.geometry import face_points, load_pieces

EPISODES = 100


def write_tiny_packs(folder: Path) -> None:
    """Write 100 probes of the pot on two bottoms, five a grip and ten a mounting."""
    pot = load_pieces().piece("pot")
    points = face_points(pot.face)

    def rows() -> Iterator[PackedEpisode]:
        rng = np.random.default_rng(6)
        for i in range(EPISODES):
            side = 1.0 if i % 3 else -1.0
            observation = rng.normal(size=(20, 258)).astype(np.float32)
            observation[:, 256] += np.float32(8 * side)
            yield PackedEpisode(observation, {
                "episode": f"e{i}", "x_um": 0, "y_um": 0, "sigma_um": 0, "source": "commanded",
                "piece": pot.name, "bottom": ("circle15", "short")[i % 2],
                "patch": patch_hex(points[:, 0] * side >= 0), "points": len(points),
                "geometry": pot.sha256, "grip_id": f"g{i // 5}", "mounting_id": f"m{i // 10}",
                "person": "simulated", "seed": i,
            })  # fmt: skip

    write_packs(folder, "w", rows(), {"test": "yes"})
