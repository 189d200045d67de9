"""
Contact patches from arrays of your own
=======================================

The recording of another program enters as arrays: for each press an observation (20, 258) and the
position of the face. The patches of five presses are fused into a belief map.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import touchdown as td

with tempfile.TemporaryDirectory() as folder, td.Dataset.open(folder, person="Ann") as dataset:
    with td.simulated_bench() as bench:
        bench.dataset = dataset
        bench.run(td.CollectRequest(piece="pot", bottom="circle15", count=5, seed=3, person="Ann"))
    episodes = [dataset.read(entry.uuid) for entry in dataset]

# Replace these two arrays by those of your recording.
observations = np.array([episode.observation for episode in episodes])
offsets_mm = np.array([episode.offset_mm for episode in episodes])
print(observations.shape, observations.dtype, offsets_mm.shape)

# %%
# A row holds one tick: displacements of 2 x 63 markers in px, then force in N and moment in N·m.
# The offset is the centre of the face in any frame fixed to the bottom.

estimator = td.Estimator.shipped(td.load_pieces().top("pot"))
belief = td.Belief.unknown(td.StackSettings().belief, tuple(offsets_mm[0]))
for number, (observation, offset_mm) in enumerate(zip(observations, offsets_mm, strict=True)):
    patch = estimator.estimate(td.Episode(str(number), "pot", observation, offset_mm))
    belief = belief.updated(patch, tuple(offset_mm))
    print(f"press {number}: contact on {np.mean(patch.probability > 0.5):.0%} of the face")

figure, axis = plt.subplots(figsize=(5, 4.2))
centres = belief.map.cell_centres_mm()
picture = axis.pcolormesh(centres[..., 0], centres[..., 1], belief.map.probability, vmin=0, vmax=1)
outline = td.load_pieces().bottom("circle15").upper.polygon()
axis.plot(*outline.T, "w--", linewidth=0.8, label="bottom")
axis.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)", xlim=(-20, 20), ylim=(-20, 20))
axis.legend()
figure.colorbar(picture, label="probability of support")
plt.show()
