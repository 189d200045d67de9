"""
Signals of a probe
==================

An episode is the input of the method: 20 ticks, 0.1 s apart, from the contact on. A tick holds the
displacements of 2 x 63 markers in px and the wrench in N and N·m.
"""

import matplotlib.pyplot as plt
import numpy as np

import touchdown as td
from touchdown.backend.core import TACTILE_CHANNELS, EpisodeRecorded

events = []
with td.simulated_bench() as bench:
    bench.events.subscribe(events.append)
    bench.run(td.StackRequest(piece="pot", bottoms=("short",), strategy="paper", seed=7))

episode = next(event.episode for event in events if isinstance(event, EpisodeRecorded))
t_s = 0.1 * np.arange(1, 21)
wrench = episode.observation[:, TACTILE_CHANNELS:]
markers = episode.observation[:, :TACTILE_CHANNELS].reshape(20, 2, 2, 7, 9)

# %%
# Fz is positive while the piece is pressed down. The gels shear upwards, which is -v in the image.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
for column, name in enumerate(("Fx", "Fy", "Fz")):
    axes[0].plot(t_s, wrench[:, column], label=name)
for finger, name in enumerate(("left", "right")):
    axes[1].plot(t_s, markers[:, finger, 1].mean(axis=(1, 2)), label=f"{name} gel, mean v")
axes[0].set(xlabel="time since contact (s)", ylabel="force (N)")
axes[1].set(xlabel="time since contact (s)", ylabel="marker displacement (px)")
for axis in axes:
    axis.legend()
figure.tight_layout()
plt.show()
