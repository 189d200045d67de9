"""
Margin over the positions of a piece
====================================

The exact statics give the margin of a placement: the signed distance of the centre of mass to
the edge of the support. A piece stands where it is positive.
"""

import matplotlib.pyplot as plt
import numpy as np

import touchdown as td
from touchdown.backend.geometry import Tower, judge_tower

pieces = td.load_pieces()
bottom, mug = pieces.bottom("short"), pieces.top("mug")
tower = Tower((bottom.body(),))
grid_mm = np.linspace(-16.0, 16.0, 41)
margins_mm = np.array(
    [
        [judge_tower(tower.with_top(mug.body((float(x), float(y))))).margin_mm for x in grid_mm]
        for y in grid_mm
    ]
)

# %%
# The centre of mass of the mug lies beside the middle of its face, because of its handle.

figure, axes = plt.subplots(figsize=(5.5, 4.5))
shown_mm = np.clip(margins_mm, -10.0, 10.0)  # minus infinity where the faces do not overlap
picture = axes.contourf(grid_mm, grid_mm, shown_mm, 24, cmap="RdBu", vmin=-10, vmax=10)
axes.contour(grid_mm, grid_mm, margins_mm, [0.0], colors="k")
axes.plot(*bottom.upper.polygon().T, "k--", linewidth=1, label="bottom")
axes.set(aspect="equal", xlabel="x of the mug (mm)", ylabel="y of the mug (mm)")
figure.colorbar(picture, label="margin (mm)")
axes.legend()
plt.show()
