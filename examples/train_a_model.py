"""
Train a model
=============

Simulate labelled probes, train a small network on them and measure it on others. A few hundred
probes and epochs show the steps; a useful model takes thousands of probes.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import touchdown as td
from touchdown.backend.cli import main
from touchdown.backend.learning import TrainingEpoch

reports = []
with tempfile.TemporaryDirectory() as folder:
    data, others, model = (Path(folder) / name for name in ("data", "others", "pot.safetensors"))
    simulate = ["simulate", "--piece", "pot", "--probes-per-grip", "2", "--workers", "1"]
    main([*simulate, "--bottoms", "square15", "--episodes", "480", "--out", str(data)])
    main([*simulate, "--bottoms", "circle15", "--episodes", "60", "--out", str(others)])
    td.train_model(data, "pot", model, epochs=6, threads=1, on_report=reports.append)
    scores = td.evaluate(model, others)["all"]
print(f"{scores.episodes} episodes, IoU {scores.iou:.2f}")

# %%
# The weights of the epoch of lowest validation loss are kept.

epochs = [report for report in reports if isinstance(report, TrainingEpoch)]
figure, axes = plt.subplots(figsize=(5.5, 3.6))
axes.plot([each.epoch for each in epochs], [each.train_loss for each in epochs])
axes.plot([each.epoch for each in epochs], [each.validation_loss for each in epochs])
axes.set(xlabel="epoch", ylabel="loss")
axes.legend(["training", "validation"])
plt.show()
