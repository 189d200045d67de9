"""
Belief map after each probe
===========================

Each probe adds evidence to the belief map: the probability that a cell of the bottom supports the
piece. The map of a trial is shown after each of its probes, with the hull of the confident support
and the centre of mass.
"""

import matplotlib.pyplot as plt

import touchdown as td
from touchdown.backend.core import BeliefUpdated, StabilityJudged

events = []
with td.simulated_bench() as bench:
    bench.events.subscribe(events.append)
    bench.run(td.StackRequest(piece="barrel", bottoms=("short",), strategy="paper", seed=3))

maps = [event.belief for event in events if isinstance(event, BeliefUpdated)]
judged = [event.stability for event in events if isinstance(event, StabilityJudged)]
outline = td.load_pieces().bottom("short").upper.polygon()

# %%
# The outline of the bottom is drawn for comparison. The method does not know it.

figure, axes = plt.subplots(1, len(maps), figsize=(3.2 * len(maps), 3.6), squeeze=False)
for axis, belief, stability in zip(axes[0], maps, judged, strict=True):
    centres = belief.cell_centres_mm()
    picture = axis.pcolormesh(centres[..., 0], centres[..., 1], belief.probability, vmin=0, vmax=1)
    axis.fill(*stability.hull_mm.T, fill=False, color="C1")
    axis.plot(*stability.centre_mm, "w+", markersize=12)
    axis.plot(*outline.T, "w--", linewidth=0.8)
    axis.set(aspect="equal", xlabel="x (mm)", xlim=(-12, 30), ylim=(-22, 20))
    axis.set_title(f"{belief.probes} probes\nmargin {stability.margin_mm:.1f} mm")
axes[0, 0].set_ylabel("y (mm)")
figure.colorbar(picture, ax=axes, label="probability of support", shrink=0.7)
plt.show()
