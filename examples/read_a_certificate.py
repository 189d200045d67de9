"""
Read a certificate
==================

A certificate bounds the share of unsafe releases with 95 % confidence, from counts on fresh scenes.
It holds for one bench, one network, one accepted risk and one set of settings.
"""

import matplotlib.pyplot as plt
import numpy as np

from touchdown.backend.learning.fused import ReleaseCounts, releases_needed, risk_bound

counts = ReleaseCounts.of(0.07, 0.025, scenes=3000, placed=2783, unsafe=17, toppled=3)
print(f"unsafe at most {counts.bound:.2%} of releases, {counts.unsafe} of {counts.releases}")
print("releases without an unsafe one that show 1 %:", releases_needed(0.01))

# %%
# The bound of Clopper and Pearson falls with the number of releases. A certificate needs 1 %.

releases = np.unique(np.geomspace(60, 6000, 60).astype(int))
figure, axes = plt.subplots(figsize=(6, 4))
for unsafe in (0, 4, 17):
    bounds = [100 * risk_bound(unsafe, int(n)) for n in releases]
    axes.plot(releases, bounds, label=f"{unsafe} unsafe")
axes.axhline(1.0, color="k", linestyle="--", linewidth=1)
axes.plot(counts.releases, 100 * counts.bound, "ko", label="the counts above")
axes.set(xscale="log", yscale="log", xlabel="releases", ylabel="bound of the unsafe (%)")
axes.legend()
plt.show()
