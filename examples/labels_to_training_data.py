"""
From labels to training data
============================

The label of a probe is the displacement of the face relative to the bottom. The contact patch that
a network learns is not stored: it follows from the label and both outlines.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import touchdown as td
from touchdown.backend.annotations import load_training_set
from touchdown.backend.geometry import face_points

with tempfile.TemporaryDirectory() as folder:
    with td.Dataset.open(folder, person="Ann") as dataset, td.simulated_bench() as bench:
        bench.dataset = dataset
        bench.run(td.CollectRequest(piece="pot", bottom="square15", count=3, seed=4, person="Ann"))
        print(dataset.counts())
    rows = load_training_set(Path(folder), "pot", labels="drafts")
    patch, offset_mm = rows.patch, rows.offset_mm
print("input", rows.observation.shape, "target", patch.shape)

# %%
# Measured labels of the simulated bench are drafts. A person accepts them and another one approves
# them; by default only approved labels train a model.

pieces = td.load_pieces()
points_mm = face_points(pieces.top("pot").face)
figure, axes = plt.subplots(1, len(patch), figsize=(3.2 * len(patch), 3.4), sharey=True)
for axis, mine, at_mm in zip(axes, patch, offset_mm, strict=True):
    axis.scatter(*(points_mm + at_mm).T, c=mine, s=6, cmap="Paired")
    axis.plot(*pieces.bottom("square15").upper.path().T, "k--", linewidth=1)
    axis.set(aspect="equal", xlabel="x (mm)", title=f"label {at_mm[0]:.1f}, {at_mm[1]:.1f} mm")
axes[0].set_ylabel("y (mm)")
figure.tight_layout()
plt.show()
