"""
Weigh the held piece
====================

The centre of mass of a piece may be unknown. The hand leans in six poses, and the wrist sensor
gives mass and centre of mass with their uncertainties. The trial judges by the measured one.
"""

import matplotlib.pyplot as plt
from matplotlib.patches import Ellipse

import touchdown as td
from touchdown.backend.core import PieceWeighed

events = []
with td.simulated_bench() as bench:
    bench.events.subscribe(events.append)
    result = bench.run(
        td.StackRequest(piece="brick", bottoms=("short",), strategy="fused", seed=4, weigh=True)
    )
weighed = next(event for event in events if isinstance(event, PieceWeighed))
print(f"{weighed.mass_g:.1f} g, s.d. {weighed.mass_sigma_g:.1f} g")
print(result.trials[0].outcome.value, "after", result.trials[0].probes, "probes")

# %%
# The ellipse shows two standard uncertainties.

brick = td.load_pieces().top("brick")
figure, axes = plt.subplots(figsize=(5.5, 4))
axes.fill(*brick.face.polygon().T, color="0.88", label="face of the brick")
axes.plot(*weighed.com_xy_mm, "k+", label="centre of mass, measured")
width_mm, height_mm = (4.0 * sigma for sigma in weighed.sigma_mm)
axes.add_patch(Ellipse(weighed.com_xy_mm, width_mm, height_mm, fill=False, color="C1"))
axes.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
axes.legend()
plt.show()
