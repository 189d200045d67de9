"""
Evaluate a strategy
===================

Run the same seeds with two strategies and count the placed pieces. ``pick-and-place`` releases
without a probe. The intervals are those of Wilson for 95 %: with so few trials they are wide.
``touchdown experiment beyond`` runs hundreds of trials.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import binomtest

import touchdown as td

TRIALS = 3
placed, probes = {}, {}
with td.simulated_bench(preset="bench-v1") as bench:
    for strategy in ("pick-and-place", "fused"):
        request = td.StackRequest(
            piece="pot", bottoms=("short",), strategy=strategy, seed=100, trials=TRIALS
        )
        trials = bench.run(request).trials
        placed[strategy] = sum(trial.outcome is td.Outcome.PLACED for trial in trials)
        probes[strategy] = np.mean([trial.probes for trial in trials])
        print(f"{strategy}: {placed[strategy]} of {TRIALS} placed, {probes[strategy]:.1f} probes")

# %%
# The same seed gives the same scene, so that the trials of both strategies are paired.

figure, axes = plt.subplots(figsize=(4.5, 3.6))
for column, count in enumerate(placed.values()):
    low, high = binomtest(count, TRIALS).proportion_ci(method="wilson")
    share = count / TRIALS
    axes.errorbar(column, share, [[share - low], [high - share]], fmt="o", capsize=6)
axes.set_xticks(range(2), list(placed))
axes.set(xlim=(-0.5, 1.5), ylim=(-0.02, 1.02), ylabel="share placed")
plt.show()
