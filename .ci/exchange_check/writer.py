"""Write episodes with LeRobot, once for each line of standard input: ``writer.py ROWS.npz DIR``.

Prints the seconds of each dataset, from its first frame until all its files are on the disk.
"""

import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

SHAPES = {"observation.markers": (252,), "observation.ft": (6,), "label.offset_mm": (2,)}


def write(root: Path, observation: np.ndarray, offset_mm: np.ndarray) -> None:
    """Write the episodes (n, 20, 258) with their labels (n, 2), durably."""
    features = {key: {"dtype": "float32", "shape": s, "names": None} for key, s in SHAPES.items()}
    dataset = LeRobotDataset.create("touchdown/check", 10, features, root=root, use_videos=False)
    for rows, offset in zip(observation, offset_mm, strict=True):
        for row in rows:
            values = (row[:252], row[252:], offset)
            dataset.add_frame({**dict(zip(SHAPES, values, strict=True)), "task": "press"})
        dataset.save_episode()
    dataset.finalize()
    for path in [root, *root.rglob("*")]:
        handle = os.open(path, os.O_RDONLY)
        os.fsync(handle)
        os.close(handle)


def main(rows: Path, folder: Path) -> None:
    """Answer every line with the seconds of one dataset."""
    with np.load(rows) as stored:
        observation, offset_mm = stored["observation"], stored["offset_mm"]
    for _ in sys.stdin:
        shutil.rmtree(folder, ignore_errors=True)
        begun_s = time.perf_counter()
        write(folder, observation, offset_mm)
        sys.stdout.write(f"{time.perf_counter() - begun_s}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
