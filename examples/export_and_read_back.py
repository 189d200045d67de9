"""
Export, and read back with h5py
===============================

Export a dataset to the HDF5 layout of robomimic and read it with h5py, as a program would that
knows nothing of Touchdown. Every number is the same to the last bit.
"""

import tempfile
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np

import touchdown as td

with tempfile.TemporaryDirectory() as folder:
    with td.Dataset.open(Path(folder) / "dataset", person="Ann") as dataset:
        with td.simulated_bench() as bench:
            bench.dataset = dataset
            bench.run(td.CollectRequest(piece="pot", bottom="circle15", count=2, person="Ann"))
        done = td.export(dataset, "robomimic", Path(folder) / "out", states=("draft",))
        episodes = [dataset.read(entry.uuid).observation for entry in dataset]
    (file,) = done.folder.glob("*.hdf5")
    with h5py.File(file) as content:
        demos = [content["data"][name]["obs"]["markers"][:] for name in sorted(content["data"])]
print(done.episodes, "episodes,", demos[0].shape, demos[0].dtype)
assert all(any(np.array_equal(d, e[:, :252]) for e in episodes) for d in demos)

# %%
# Displacements of all markers of one exported episode.

figure, axes = plt.subplots(figsize=(6, 3.6))
axes.imshow(demos[0].T, aspect="auto", cmap="coolwarm", vmin=-20, vmax=20, interpolation="nearest")
axes.set(xlabel="tick", ylabel="channel", title="markers (px), read by h5py")
plt.show()
