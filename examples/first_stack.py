"""
Stack a pot in five lines
=========================

Place a pot on a short cylinder by touch. The bench is simulated: no hardware is needed.
"""

import touchdown as td

with td.simulated_bench() as bench:
    events = []
    bench.events.subscribe(events.append)
    result = bench.run(td.StackRequest(piece="pot", bottoms=("short",), strategy="fused", seed=7))
print(result.trials[0].outcome.value, "after", result.trials[0].probes, "probes")

# %%
# Everything that happens on a bench is an event. The episodes hold the position of each probe, the
# bottom is a piece of the library.

import matplotlib.pyplot as plt
import numpy as np

from touchdown.backend.core import EpisodeRecorded

bottom, pot = td.load_pieces().bottom("short"), td.load_pieces().top("pot")
episodes = [event.episode for event in events if isinstance(event, EpisodeRecorded)]
at_mm = np.array([episode.offset_mm for episode in episodes])
figure, axes = plt.subplots(figsize=(5, 5))
axes.fill(*bottom.upper.polygon().T, color="0.85", label="bottom")
axes.plot(*(pot.face.polygon() + at_mm[-1]).T, "C0", label="face of the pot, last probe")
axes.plot(*at_mm.T, "o-", color="C1", label="centre of the face, each probe")
axes.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)", title=result.trials[0].reason)
axes.legend(loc="upper right")
plt.show()
