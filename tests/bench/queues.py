"""Figures of the queues that a model orders: do wrong labels come first, and are they badged?

The queue of what the model is unsure of looks at no label: it is measured by how often the model
itself is wrong there.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.labels import SetState
from touchdown.backend.annotations.queues import SCORES
from touchdown.backend.annotations.values import Label
from touchdown.backend.bench.assembly import shipped_model
from touchdown.backend.geometry.outlines import true_patch
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.placement.estimator import NOTABLE_SIGMAS, Ensemble, Estimator, OffsetGrid
from touchdown.backend.placement.label_review import score_labels

ROOT = Path(__file__).resolve().parents[2]
BOTTOMS, EACH, SEED = "circle15,circle25,square15", 1000, 77
WRONG_SHARE, WRONG_MM = 0.02, (1.0, 3.0)
FIRST = 100
NOT_FOR_ERRORS = {"audit": "random", "uncertainty": "looks at no label"}
DRAWN, WORST = 300, 0.1
"""So many random episodes tell how bad the worst tenth of the model's patches is."""
Wrong = dict[str, Label]
"""What each wrong label says; all others are as commanded."""


@figure("queues")
def wrong_labels() -> list[Figure]:
    """3,000 simulated probes of the pot, 2 % of the labels wrong in two ways; shipped model."""
    with tempfile.TemporaryDirectory() as name:
        packs = Path(name) / "packs"
        words = ["simulate", "--piece", "pot", "--bottoms", BOTTOMS, "--episodes", str(EACH)]
        words += ["--seed", str(SEED), "--out", str(packs)]
        command = [sys.executable, "-m", "backend", *words]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        moved = _measured(packs, Path(name) / "moved", _moved, "off by 1 to 3 mm")
        return [*moved, *_measured(packs, Path(name) / "next", _of_the_next, "of the next probe")]


def _measured(
    packs: Path, folder: Path, make: Callable[[Dataset], Wrong], kind: str
) -> list[Figure]:
    """Set labels wrong in a dataset of its own, submit all, let the model score them, measure."""
    Dataset.open(folder).close()
    shutil.copytree(packs, folder / "packs")
    with Dataset.open(folder) as dataset:
        wrong = make(dataset)
        for uuid, label in wrong.items():
            dataset.labels.set("bench", uuid, label)
        uuids = [entry.uuid for entry in dataset.episodes()]
        dataset.labels.bulk("bench", dataset.labels.preview("bench", uuids, SetState("accept")))
        models = Ensemble([Estimator.load(shipped_model("pot"), load_pieces().top("pot"))])
        count = score_labels(dataset, lambda _: models, lambda done, total: True)
        figures = _precision(dataset, set(wrong), count, kind)
        if make is _moved:
            figures += [*_badges(dataset, wrong), *_unsure(dataset, models)]
        return figures


def _chosen(dataset: Dataset) -> list[int]:
    """Return which episodes get a wrong label, in the order of the dataset."""
    count = len(dataset.episodes())
    rng = np.random.default_rng(SEED)
    return sorted(rng.choice(count, round(WRONG_SHARE * count), replace=False).tolist())


def _moved(dataset: Dataset) -> Wrong:
    """Move labels by 1 to 3 mm, as a slip in the grasp or a wrong origin does."""
    rng, entries, moved = np.random.default_rng(SEED), dataset.episodes(), {}
    for k in _chosen(dataset):
        label = dataset.labels.head(entries[k].uuid).label
        turn, by_mm = rng.uniform(0, 2 * np.pi), float(rng.uniform(*WRONG_MM))
        at = label.offset_mm + by_mm * np.array([np.cos(turn), np.sin(turn)])
        x_um, y_um = np.rint(1e3 * at).astype(int).tolist()
        moved[entries[k].uuid] = Label(x_um, y_um, label.theta_mdeg, label.sigma_um)
    return moved


def _of_the_next(dataset: Dataset) -> Wrong:
    """Give an episode the label of another of its pair, as a slip by one row does."""
    entries, swapped = dataset.episodes(), {}
    for k in _chosen(dataset):
        other = next(e for e in (*entries[k + 1 :], *entries[:k]) if e.bottom == entries[k].bottom)
        swapped[entries[k].uuid] = dataset.labels.head(other.uuid).label
    return swapped


def _precision(dataset: Dataset, wrong: set[str], count: int, kind: str) -> list[Figure]:
    """Return the share of wrong labels in the first 100 of each queue."""
    base = len(wrong) / count
    figures = []
    for queue in (*SCORES, "audit"):
        first = dataset.queue(queue, "zoe", seed=SEED, limit=FIRST)
        hits = sum(uuid in wrong for uuid in first)
        share = hits / max(len(first), 1)
        note = f"{hits} of {len(wrong)} wrong labels in the first {len(first)} of {count}"
        why = NOT_FOR_ERRORS.get(queue)
        ok = None if why else share > base
        target = f"stated ({why})" if why else f"> {100 * base:.1f} (base rate)"
        name = f"queue {queue}, labels {kind} in the first {FIRST}"
        figures.append(Figure(name, 100 * share, "%", target, ok, note))
    return figures


def _unsure(dataset: Dataset, models: Ensemble) -> list[Figure]:
    """Return how often the model is wrong where it says that it is unsure; truth as simulated."""
    grids = dict[str, OffsetGrid]()

    def overlap(uuid: str) -> float:
        episode, geometry = dataset.film(uuid).episode, dataset.entry(uuid).geometry
        pair = dataset.geometry.pair(geometry)
        if geometry not in grids:
            grids[geometry] = OffsetGrid.of(pair.points_mm, pair.bottom)
        felt = models.judge(episode, grids[geometry]).patch.probability > 0.5
        x_mm, y_mm = episode.offset_mm.tolist()
        true = true_patch(pair.points_mm, (x_mm, y_mm), pair.bottom) > 0
        return float((felt & true).sum() / max((felt | true).sum(), 1))

    uuids = [entry.uuid for entry in dataset.episodes()]
    chosen = np.random.default_rng(SEED).choice(len(uuids), DRAWN, replace=False)
    usual = np.array([overlap(uuids[k]) for k in chosen.tolist()])
    first = dataset.queue("uncertainty", "zoe", limit=FIRST)
    there = np.array([overlap(uuid) for uuid in first])
    share = float((there < np.quantile(usual, WORST)).mean())
    note = f"mean IoU {there.mean():.2f} there, {usual.mean():.2f} of {DRAWN} drawn"
    return [
        Figure(f"queue uncertainty, the model's worst tenth in the first {FIRST}", 100 * share,
               "%", f"> {100 * WORST:.0f} (base rate)", share > WORST, note)
    ]  # fmt: skip


def _badges(dataset: Dataset, wrong: Wrong) -> list[Figure]:
    """Return the shares of wrong and right labels with a badge: by the others, by model alone."""
    rows = dataset.database.rows("SELECT name, episode, value FROM score")
    found = {(name, uuid): value for name, uuid, value in rows}
    uuids = [entry.uuid for entry in dataset.episodes()]
    figures = []
    for by, name, power in (("other episodes", "doubt", 0.5), ("model alone", "disagreement", 1)):
        badged = {u: found[name, u] ** power > NOTABLE_SIGMAS for u in uuids if (name, u) in found}
        bad = [is_badged for uuid, is_badged in badged.items() if uuid in wrong]
        good = [is_badged for uuid, is_badged in badged.items() if uuid not in wrong]
        hits, false = (100 * float(np.mean(one)) for one in (bad, good))
        note = f"{by}, no scene camera; of {len(bad)} off by 1 to 3 mm"
        figures += [
            Figure(f"wrong labels badged by {by}", hits, "%", ">= 95", hits >= 95, note),
            Figure(f"right labels badged by {by}", false, "%", "<= 5", false <= 5, f"{len(good)}"),
        ]
    return figures
