"""Figures of the queues that a model orders: do wrong labels come first, and are they badged?"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from backend.assembly import shipped_model
from backend.catalogue.dataset import Dataset
from backend.catalogue.scores import SCORES
from backend.catalogue.values import Label
from backend.objects.catalogue import load_catalogue
from backend.placement.estimator import Estimator
from backend.placement.label_scores import score_labels
from backend.placement.offset_fit import NOTABLE_SIGMAS
from tests.bench.registry import Figure, figure

ROOT = Path(__file__).resolve().parents[2]
BOTTOMS, EACH, SEED = "circle15,circle25,square15", 1000, 77
WRONG_SHARE, WRONG_MM = 0.02, (1.0, 3.0)
FIRST = 100


@figure("queues")
def wrong_labels() -> list[Figure]:
    """3,000 simulated probes of the pot, 2 % of the labels moved by 1 to 3 mm; shipped model."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "dataset"
        Dataset.open(folder).close()
        words = ["simulate", "--piece", "pot", "--bottoms", BOTTOMS, "--episodes", str(EACH)]
        words += ["--seed", str(SEED), "--out", str(folder / "packs")]
        command = [sys.executable, "-m", "backend", *words]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        with Dataset.open(folder) as dataset:
            wrong = _move_some(dataset)
            model = Estimator.load(shipped_model("pot"), load_catalogue().top("pot"))
            count = score_labels(dataset, lambda _: model, lambda done, total: True)
            return [*_precision(dataset, wrong, count), *_badges(dataset, wrong)]


def _move_some(dataset: Dataset) -> dict[str, float]:
    """Set 2 % of the labels wrong; return by how many mm each."""
    rng = np.random.default_rng(SEED)
    uuids = [entry.uuid for entry in dataset.episodes()]
    chosen = rng.choice(uuids, round(WRONG_SHARE * len(uuids)), replace=False).tolist()
    moved = {}
    for uuid in chosen:
        label = dataset.labels.head(uuid).label
        turn, by_mm = rng.uniform(0, 2 * np.pi), float(rng.uniform(*WRONG_MM))
        at = label.offset_mm + by_mm * np.array([np.cos(turn), np.sin(turn)])
        x_um, y_um = np.rint(1e3 * at).astype(int).tolist()
        dataset.labels.set("bench", uuid, Label(x_um, y_um, label.theta_mdeg, label.sigma_um))
        moved[uuid] = by_mm
    return moved


def _precision(dataset: Dataset, wrong: dict[str, float], count: int) -> list[Figure]:
    """Return the share of wrong labels in the first 100 of each queue."""
    base = len(wrong) / count
    figures = []
    for queue in (*SCORES, "audit"):
        first = dataset.queue(queue, "zoe", seed=SEED, limit=FIRST)
        hits = sum(uuid in wrong for uuid in first)
        share = hits / max(len(first), 1)
        note = f"{hits} of {len(wrong)} wrong labels in the first {len(first)} of {count}"
        ok = None if queue == "audit" else share > base
        target = "stated (random)" if queue == "audit" else f"> {100 * base:.1f} (base rate)"
        name = f"queue {queue}, wrong labels in the first {FIRST}"
        figures.append(Figure(name, 100 * share, "%", target, ok, note))
    return figures


def _badges(dataset: Dataset, wrong: dict[str, float]) -> list[Figure]:
    """Return the shares of wrong and of right labels that are notably off the model's."""
    rows = dataset.database.rows("SELECT episode, value FROM score WHERE name = 'disagreement'")
    sigmas: dict[str, float] = dict(rows)
    bad = [sigmas[uuid] for uuid in sigmas if uuid in wrong]
    good = [sigmas[uuid] for uuid in sigmas if uuid not in wrong]
    sigma_mm = [
        suggestion.label.sigma_um / 1e3
        for uuid in sigmas
        if (suggestion := dataset.scores.suggestion(uuid)) is not None
        and suggestion.label.sigma_um is not None
    ]
    found, false = _share(bad), _share(good)
    note = f"model alone, no scene camera; its sigma: median {np.median(sigma_mm):.2f} mm"
    known = f"{len(bad)} labels off by 1 to 3 mm; {note}"
    return [
        Figure("wrong labels badged", 100 * found, "%", ">= 95", found >= 0.95, known),
        Figure("right labels badged", 100 * false, "%", "<= 5", false <= 0.05, f"{len(good)}"),
    ]


def _share(sigmas: Sequence[float]) -> float:
    return float(np.mean(np.array(sigmas) > NOTABLE_SIGMAS)) if sigmas else float("nan")
