"""Write what the readers must find: ``truth.py DATASET OUT.npz`` (in the product's environment)."""

import json
import sys
from pathlib import Path

import numpy as np

from touchdown.backend.annotations import Dataset


def main(folder: Path, out: Path) -> None:
    """Keep observation, offset and patch of every episode, straight from the dataset."""
    arrays = {}
    with Dataset.open(folder, create=False, write=False) as dataset:
        for entry in dataset.episodes():
            label = dataset.labels.head(entry.uuid).label
            arrays[f"{entry.uuid}/observation"] = dataset.read(entry.uuid).observation
            arrays[f"{entry.uuid}/um"] = np.array([label.x_um, label.y_um])
            arrays[f"{entry.uuid}/patch"] = dataset.patch(entry.uuid).touching
    np.savez(out, **arrays)
    sys.stdout.write(json.dumps({"episodes": len(arrays) // 3}) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
