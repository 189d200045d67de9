"""
Track the markers of a gel
==========================

Collect one probe, read its tactile images, and track the 63 markers through them. The same function
tracks recordings of a real gel.
"""

import tempfile

import matplotlib.pyplot as plt

import touchdown as td

with tempfile.TemporaryDirectory() as folder, td.Dataset.open(folder, person="Ann") as dataset:
    with td.simulated_bench() as bench:
        bench.dataset = dataset
        bench.run(td.CollectRequest(piece="pot", bottom="circle15", count=1, person="Ann"))
    (entry,) = dataset
    frames = [f for f in dataset.read(entry.uuid).recording.frames if f.finger == "left"]

fields = td.track_markers([frame.image for frame in frames])
print(len(fields), "images, quality of the last one", round(fields[-1].quality, 3))

# %%
# Displacements are measured from the first image. Arrows are enlarged three times.

largest = max(fields, key=lambda field: abs(field.displacement_px).max())
figure, axes = plt.subplots(figsize=(6.4, 4.8))
axes.imshow(frames[fields.index(largest)].image[..., ::-1])
axes.quiver(
    *largest.position_px.T, *largest.displacement_px.T, color="yellow", angles="xy",
    scale_units="xy", scale=1 / 3, width=0.004,
)  # fmt: skip
axes.set(xlabel="u (px)", ylabel="v (px)")
plt.show()
