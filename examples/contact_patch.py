"""
Contact patch of one probe
==========================

The network of the paper estimates which points of the grasped face touch the support. On the
simulated bench the true patch is known. It follows from the two outlines and the displacement.
"""

import matplotlib.pyplot as plt

import touchdown as td
from touchdown.backend.core import PatchEstimated
from touchdown.backend.geometry import true_patch

events = []
with td.simulated_bench() as bench:
    bench.events.subscribe(events.append)
    bench.run(td.StackRequest(piece="mushroom", bottoms=("short",), strategy="paper", seed=5))

first = next(event for event in events if isinstance(event, PatchEstimated))
points_mm, probability = first.patch.points_mm, first.patch.probability
bottom = td.load_pieces().bottom("short").upper
truth = true_patch(points_mm, first.offset_mm, bottom)
right = (probability > 0.5) == truth
print(f"{right.mean():.0%} of the points are right")

# %%
# Points are in the frame of the face; the bottom is drawn at its commanded position.

figure, axes = plt.subplots(figsize=(5.5, 4.5))
picture = axes.scatter(*points_mm.T, c=probability, vmin=0, vmax=1, s=14)
axes.scatter(*points_mm[~right].T, facecolors="none", edgecolors="C3", s=30, label="wrong")
axes.plot(*(bottom.polygon() - first.offset_mm).T, "k--", linewidth=1, label="bottom")
axes.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
figure.colorbar(picture, label="probability of contact")
axes.legend()
plt.show()
