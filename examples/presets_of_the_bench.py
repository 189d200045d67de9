"""
Quiet and hard benches
======================

The presets of the simulated bench differ in noise and in the spread of friction, stiffness and
position. The same probe is shown on three of them.
"""

import matplotlib.pyplot as plt
import numpy as np

import touchdown as td
from touchdown.backend.core import TACTILE_CHANNELS, EpisodeRecorded

forces = {}
for preset in ("quiet", "mixed", "hard"):
    events = []
    with td.simulated_bench(preset=preset) as bench:
        bench.events.subscribe(events.append)
        bench.run(td.StackRequest(piece="pot", bottoms=("short",), strategy="paper", seed=11))
    episode = next(event.episode for event in events if isinstance(event, EpisodeRecorded))
    forces[preset] = episode.observation[:, TACTILE_CHANNELS:]

# %%
# The moments tell where the support lies, and are small compared with their noise.

t_s = 0.1 * np.arange(1, 21)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
for preset, wrench in forces.items():
    axes[0].plot(t_s, wrench[:, 2], label=preset)
    axes[1].plot(t_s, 1e3 * wrench[:, 3], label=preset)
axes[0].set(xlabel="time since contact (s)", ylabel="Fz (N)")
axes[1].set(xlabel="time since contact (s)", ylabel="Tx (N·mm)")
axes[0].legend()
figure.tight_layout()
plt.show()
