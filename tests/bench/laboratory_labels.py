"""Labels of a hidden laboratory: learning curves by their number, and those that a queue saves.

``python -m tests.bench.laboratory_labels --curves SEED ...`` needs the result of each laboratory in
``--out``, which ``tests.bench.laboratories`` writes; ``--active SEED ...`` needs none.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tempfile
from collections.abc import Collection, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.bench.figures import DATA, Figure, figure, stated
from tests.bench.laboratories import (
    FOLDER,
    KNOWN,
    draw_laboratory,
    kept,
    save_result,
    stored_results,
    with_result,
    write_bench,
)
from touchdown.backend.cli.command_line import main as command_line
from touchdown.backend.config import (
    SimulationSettings,
    StabilitySettings,
    StackSettings,
    TrainingSettings,
    load_simulation,
)
from touchdown.backend.core import InputError, write_atomically
from touchdown.backend.episodes import Split, TrainingRows, join_rows, load_rows
from touchdown.backend.experiments.document import curves_chart
from touchdown.backend.experiments.nuisances import bench_within
from touchdown.backend.experiments.trials import (
    BatchModel,
    SceneSetup,
    stack_in_lockstep,
    start_scene,
)
from touchdown.backend.geometry import face_points, load_pieces, true_patch
from touchdown.backend.learning import load_checkpoint, stable_flags, use_one_thread
from touchdown.backend.learning.inference import modality_columns
from touchdown.backend.learning.metrics import CONTACT_LEVEL, iou
from touchdown.backend.learning.training import Trainer, load_network, predict
from touchdown.backend.placement import label_review, shipped_model
from touchdown.backend.sensing import EpisodeLimits

CURVES, ACTIVE = "learning-curves", "labels-saved"
# Learning curves: the shipped network of the pot and paired trials of the paper's method.
CURVE_LABELS, REPEATS, POOL, TESTED = (0, 50, 200, 500), 3, 600, 400
RANGE_BENCHES, OF_EACH = 10, 100  # benches within the ranges; probes on each of three bottoms
CURVE_TRIALS, CURVE_SEED = 100, 33_000  # trials over each of two bottoms
MIXED = 400  # simulated probes beside the labelled ones of a fine-tuning
NOMINAL, IDENTIFIED = "nominal, fine-tuned", "identified, fine-tuned"
ALONE, OWN = "laboratory alone", "own bench"
FROM_LABELS = TrainingSettings(epochs=40, batch=16, keep="last", patience=100)
UNSEEN = "short,long"
LABORATORY_SEED, TEST_SEED = 31_000, 32_000
# Active labelling: the shipped network, at the learning rate of ``train --from``.
BATCH, ACTIVE_SEEDS = 25, 10  # batch: as the window offers it
MOST = {"single": 150, "random": 100, "queue": 100}  # labels
SHIPPED_TUNING = TrainingSettings(learning_rate=1e-4, batch=32, keep="last", patience=100)
DRAWN_FROM, AVAILABLE = 2000, 1000  # probes of a laboratory; those of a seed that wait for a label
LABEL_MM = 0.2  # error of a label of a person, as the page assumes it
LEARNS = 0.05  # least gain of IoU by the labels of single probes


def simulated_probes(bench: Path, count: int, seed: int, bottoms: str, *sizes: int) -> TrainingRows:
    """Return ``count`` probes of the pot over each of ``bottoms``; ``sizes``: of grip, mounting."""
    with tempfile.TemporaryDirectory() as name:
        per_grip, per_mounting = sizes
        words = ["simulate", "--piece", "pot", "--bottoms", bottoms, "--episodes", count, "--seed",
                 seed, "--bench", bench, "--out", name, "--workers", 1, "--probes-per-grip",
                 per_grip, "--grips-per-mounting", per_mounting, "--json"]  # fmt: skip
        with redirect_stdout(io.StringIO()):
            assert command_line(list(map(str, words))) == 0
        return load_rows(Path(name))


def trained(
    rows: TrainingRows, settings: TrainingSettings, seed: int, start: Any = None, more: Any = None
) -> Any:
    """Return a network trained on ``rows``, from ``start`` if given, with some of ``more``."""
    if more is not None:
        chosen = np.random.default_rng(seed).choice(len(more), MIXED, replace=False)
        rows = join_rows([rows, more.take(np.sort(chosen))])
    # The last epoch counts, so that nothing is held out.
    split = Split(np.arange(len(rows)), np.arange(8), "")
    trainer = Trainer(rows, settings.model_copy(update={"seed": seed}), split=split)
    if start is not None:
        trainer.model.load_state_dict(start.state_dict())
    for _ in trainer.epochs():
        pass
    return trainer.best_model()


def patches(network: Any, rows: TrainingRows) -> Any:
    """Return the probabilities (n, N) of contact."""
    return predict(network, rows.inputs(np.arange(len(rows))), modality_columns("FT+Tac"))


def tested(network: Any, rows: TrainingRows) -> dict[str, float]:
    """Return IoU, and balanced accuracy of stability from one probe."""
    probability, points = patches(network, rows), face_points(load_pieces().piece("pot").face)
    said = stable_flags(probability > StabilitySettings().delta, points)
    stable = stable_flags(rows.patch, points)
    balanced = 0.5 * (np.mean(said[stable]) + np.mean(~said[~stable]))
    return {
        "iou": iou(probability > CONTACT_LEVEL, rows.patch),
        "balanced_stability": float(balanced),
    }


@cache
def laboratory_probes(
    seed: int, out: Path, count: int = POOL
) -> tuple[Path, TrainingRows, TrainingRows]:
    """Return the nominal bench, ``count`` labelled probes of the laboratory, and test probes."""
    drawn, _ = draw_laboratory(seed, drivers=True)
    content = drawn.model_dump(mode="json", exclude_none=True)
    there = write_bench(out / f"laboratory-{seed}.toml", content)
    pool = simulated_probes(there, count // 3 + 1, LABORATORY_SEED, KNOWN, 15, 3)
    test = simulated_probes(there, TESTED // 2, TEST_SEED, UNSEEN, 5, 2)
    return write_bench(out / "nominal.toml", {}), pool, test


def in_trials(network: Any, bench: SimulationSettings) -> dict[str, float]:
    """Return the shares of trials of the paper's method that end placed, and after a fall."""
    piece = load_pieces().piece("pot")

    def probability(observation: NDArray[np.float32]) -> NDArray[np.float64]:
        return predict(network, observation, modality_columns("FT+Tac")).astype(np.float64)

    model, ends = BatchModel(probability, face_points(piece.face), None), list[str]()
    for number, bottom in enumerate(UNSEEN.split(",")):
        case = SceneSetup.of(load_pieces(), "pot", (bottom,), bench)
        first = CURVE_SEED + 1000 * number
        scenes = [start_scene(case, first + k) for k in range(CURVE_TRIALS)]
        there = [scene for scene in scenes if scene is not None]
        results = stack_in_lockstep(there, model, StackSettings(), EpisodeLimits())
        ends += [str(end.as_json()["outcome"]) for end in results]
    released = max(ends.count("placed") + ends.count("fell"), 1)
    return {"success": ends.count("placed") / len(ends), "unsafe": ends.count("fell") / released}


def learning_curves(seed: int, out: Path) -> dict[str, Any]:
    """Test contact-patch networks in one laboratory by the number of its labelled probes.

    The shipped network, which was trained on the nominal bench; the same trained further on benches
    within the ranges of the identified one; both fine-tuned on labels and some simulated probes of
    their bench; and a network from labels alone. ``REPEATS`` draws of the labels, the same for all.
    """
    use_one_thread()
    nominal, pool, test = laboratory_probes(seed, out)
    names = f"laboratory-{seed}-drivers.json", f"laboratory-{seed}.json"
    found = json.loads(next(out / name for name in names if (out / name).is_file()).read_text())
    there, _ = draw_laboratory(seed, drivers=True)
    identified = SimulationSettings.model_validate(found["bench"])
    within = [bench_within(identified, found["ranges"], k) for k in range(RANGE_BENCHES)]
    simulated = {NOMINAL: simulated_probes(nominal, MIXED // 3 + 1, 1, KNOWN, 10, 2), IDENTIFIED:
                 join_rows([simulated_probes(
                     write_bench(out / f"within-{seed}.toml",
                                 bench.model_dump(mode="json", exclude_none=True)),
                     OF_EACH, k, KNOWN, 10, 2) for k, bench in enumerate(within)])}  # fmt: skip
    shipped = load_network(load_checkpoint(shipped_model("pot")))
    start = {NOMINAL: shipped,
             IDENTIFIED: trained(simulated[IDENTIFIED], SHIPPED_TUNING, 0, shipped)}  # fmt: skip

    def row(arm: str, labels: int, repeat: int, network: Any) -> dict[str, Any]:
        known = {"arm": arm, "labels": labels, "repeat": repeat}
        return {**known, **tested(network, test), **in_trials(network, there)}

    rows = [{"arm": OWN, "labels": 0, "repeat": 0, **in_trials(shipped, load_simulation())}]
    rows += [row(arm, 0, 0, network) for arm, network in start.items()]
    for repeat in range(REPEATS):
        rng = np.random.default_rng([seed, repeat])
        order = rng.permutation(len(pool))
        errors = LABEL_MM * rng.standard_normal((len(pool), 2))
        for labels in CURVE_LABELS[1:]:
            own = given_labels(pool, {int(k): int(k) for k in order[:labels]}, errors)
            rows += [
                row(
                    arm,
                    labels,
                    repeat,
                    trained(own, SHIPPED_TUNING, repeat, start[arm], simulated[arm]),
                )
                for arm in start
            ]
            rows.append(row(ALONE, labels, repeat, trained(own, FROM_LABELS, repeat)))  # fmt: skip
            sys.stderr.write(f"{seed}: {rows[-3:]}\n")
    return {"seed": seed, "tested": len(test), "trials": 2 * CURVE_TRIALS, "rows": rows}


def mean_curves(laboratories: Sequence[Mapping[str, Any]], quantity: str) -> dict[str, Any]:
    """Return the means of a quantity over laboratories and repeats, by arm and number of labels."""
    rows = [row for one in laboratories for row in one["rows"]]
    return {
        arm: np.array([
            np.mean([r[quantity] for r in rows if (r["arm"], r["labels"]) == (arm, n)] or [np.nan])
            for n in CURVE_LABELS
        ])
        for arm in (NOMINAL, IDENTIFIED, ALONE)
    }  # fmt: skip


QUANTITIES = {"iou": "IoU", "balanced_stability": "balanced stability", "success": "success"}


@figure("identification")
def learning_curves_of_laboratories() -> list[Figure]:
    """State and draw the learning curves in docs/results, which ``main`` adds."""
    of = stored_results(CURVES)
    if not of:
        raise InputError("There is no result.", CURVES, "Run --curves first.")
    for name, title in QUANTITIES.items():
        labels = np.array(CURVE_LABELS, float)
        drawn = curves_chart(title, labels, mean_curves(of, name), ("labelled probes", ""))
        write_atomically(DATA.parent / f"learning-curves-{name}.svg", drawn.encode())
    own = np.mean([row["success"] for one in of for row in one["rows"] if row["arm"] == OWN])
    figures = [stated(f"learning curves ({len(of)}): success on the own bench", 100 * own, "%")]
    for quantity, title in {**QUANTITIES, "unsafe": "unsafe of released"}.items():
        for arm, means in mean_curves(of, quantity).items():
            note = ", ".join(f"{n} labels: {100 * mean:.1f}" for n, mean in zip(
                CURVE_LABELS, means, strict=True) if mean == mean)  # fmt: skip
            name = f"learning curves ({len(of)}): {title} with {CURVE_LABELS[-1]} labels, {arm}"
            figures.append(stated(name, 100 * float(means[-1]), "%", note))
    return figures


def active_labelling(seed: int, out: Path) -> dict[str, Any]:
    """Count the labels for equal IoU, in the order of the queue and in random order.

    Each seed draws ``AVAILABLE`` probes of the laboratory. Labels have an error of ``LABEL_MM``.
    ``single``: in random order, for their probe alone. ``random`` and ``queue``: each corrects its
    grip, and the next one is a random probe without a label, or the next of the queue. The shipped
    network is fine-tuned on all labelled probes after every ``BATCH`` labels, and the queue ordered
    again. Without a gain of ``LEARNS`` by ``single``, the others are left out.
    """
    use_one_thread()
    folder = out / "orders"
    folder.mkdir(parents=True, exist_ok=True)
    shipped = load_network(load_checkpoint(shipped_model("pot")))

    def curve(way: str, one: int) -> list[list[float]]:
        _, pool, test = laboratory_probes(seed, folder, DRAWN_FROM)
        rows = pool.take(np.random.default_rng([seed, one]).permutation(len(pool))[:AVAILABLE])
        errors = LABEL_MM * np.random.default_rng([seed, one, 1]).standard_normal((len(rows), 2))
        known, found = dict[int, int](), [[0.0, tested(shipped, test)["iou"]]]
        grips = np.array(rows.grip_id)
        for _ in range(0, MOST[way], BATCH):
            order = next_batch(rows, known) if way == "queue" else range(len(rows))
            for _ in range(BATCH):
                k = next(k for k in order if k not in known)
                same = [k] if way == "single" else np.flatnonzero(grips == grips[k]).tolist()
                known |= dict.fromkeys(same, k)
            network = trained(given_labels(rows, known, errors), SHIPPED_TUNING, one, shipped)
            found.append([float(len(known)), tested(network, test)["iou"]])
        return found

    def curves(way: str) -> list[list[list[float]]]:
        return [
            kept(folder / f"{seed}-{way}-{one}.json", partial(curve, way, one))
            for one in range(ACTIVE_SEEDS)
        ]

    lines = {"single": np.array(curves("single"))}
    gain = float(np.mean(lines["single"][:, -1, 1] - lines["single"][:, 0, 1]))
    if gain >= LEARNS:
        lines |= {way: np.array(curves(way)) for way in ("random", "queue")}
    found = {way: line[:, :, 1].tolist() for way, line in lines.items()}
    labelled = {way: line[:, :, 0].mean(axis=0).tolist() for way, line in lines.items()}
    ways = ("single", "random") if "queue" in found else ()
    shares = {f"against_{way}": labels_needed([found], way) for way in ways}
    return {"seed": seed, "batch": BATCH, "seeds": ACTIVE_SEEDS, "available": AVAILABLE,
            "random_order_gains": gain, "curves": found, "labelled_probes": labelled,
            **shares}  # fmt: skip


def given_labels(
    rows: TrainingRows, known: Mapping[int, int], errors: NDArray[np.float64]
) -> TrainingRows:
    """Return the probes ``known`` with the error of the label by which each is known."""
    pieces, index = load_pieces(), np.array(sorted(known))
    given, points = rows.take(index), face_points(pieces.piece("pot").face)
    offset_mm = given.offset_mm + errors[[known[k] for k in index.tolist()]]
    patch = np.stack([
        true_patch(points, at_mm, pieces.bottom(name).upper)
        for at_mm, name in zip(offset_mm, given.bottom, strict=True)
    ])  # fmt: skip
    return replace(given, offset_mm=offset_mm, patch=patch)


def next_batch(rows: TrainingRows, known: Collection[int]) -> list[int]:
    """Return the first probes of the queue *Most to learn*."""
    signals = rows.observation[:, label_review.COMPARED_TICKS]
    return label_review.training_order(signals, rows.grip_id, known, BATCH)


def labels_needed(laboratories: list[dict[str, list[list[float]]]], usual: str) -> dict[str, Any]:
    """Return the labels by which the queue and ``usual`` reach the IoU of ``usual`` at the end.

    The target is the mean over seeds; a curve counts as its running maximum, between labels by
    interpolation. ``share``: labels of the queue over those of ``usual``, each summed over the
    laboratories; None if the queue does not reach a target. The interval is a bootstrap over
    seeds, in which a draw that does not reach it counts as infinite.
    """
    lines = [{way: np.array(found) for way, found in one.items()} for one in laboratories]
    rng = np.random.default_rng(0)

    def needed(*, draw: bool) -> dict[str, float]:
        total = {usual: 0.0, "queue": 0.0}
        for line in lines:
            count = len(line[usual])
            rows = rng.integers(count, size=count) if draw else np.arange(count)
            target = line[usual][rows, -1].mean()
            for way in total:
                mean = np.maximum.accumulate(line[way][rows].mean(axis=0))
                at = np.arange(len(mean))  # the small slope makes a plateau end where it begins
                total[way] += BATCH * np.interp(target, mean + 1e-12 * at, at, right=np.inf)
        return total

    whole = needed(draw=False)
    drawn = [needed(draw=True) for _ in range(2000)]
    shares = np.array([one["queue"] / max(one[usual], 1.0) for one in drawn])
    low, high = np.quantile(shares, [0.025, 0.975], method="inverted_cdf").tolist()
    whole |= {"share": whole["queue"] / max(whole[usual], 1.0), "low": low, "high": high}
    finite = {key: float(value) if np.isfinite(value) else None for key, value in whole.items()}
    return {"labels": {way: finite[way] for way in (usual, "queue")}, "share": finite["share"],
            "interval": [finite["low"], finite["high"]],
            "draws_that_reach": float(np.isfinite(shares).mean())}  # fmt: skip


@figure("identification")
def labels_saved() -> list[Figure]:
    """Count the labels of the queue in the laboratories in docs/results that learn from labels."""
    curves = [one["curves"] for one in stored_results(ACTIVE) if "queue" in one["curves"]]
    if not curves:
        raise InputError("There is no result.", ACTIVE, "Run --active first.")
    figures = []
    for usual, of in (("single", "single probes"), ("random", "random grips")):
        found, must = labels_needed(curves, usual), usual == "single"
        share, (low, high) = found["share"], found["interval"]
        ends = ", ".join(f"{np.mean(one[usual], axis=0)[-1]:.3f}" for one in curves)
        figures.append(Figure(
            f"labels for equal IoU, queue against {of}, hidden laboratories ({len(curves)})",
            100 * share if share else "not reached", "%" if share else "",
            "<= 85" if must else "stated", share is not None and share <= 0.85 if must else None,
            f"IoU after {MOST[usual]} labels of {of}: {ends}"
            + (f"; 95 %: {100 * low:.1f} to {100 * high:.1f} %" if high else ""),
        ))  # fmt: skip
    return figures


def main() -> int:
    """Measure in some laboratories and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=FOLDER, metavar="FOLDER")
    parser.add_argument("--curves", type=int, nargs="+", default=[], metavar="SEED", help="learning"
                        " curves in these laboratories, which were identified")  # fmt: skip
    parser.add_argument("--active", type=int, nargs="+", default=[], metavar="SEED", help="labels "
                        "saved by the queue, in each of these laboratories")  # fmt: skip
    args = parser.parse_args()
    for seed in args.curves:
        of = with_result(CURVES, learning_curves(seed, args.out))
        save_result(CURVES, {"of": of})
    for seed in args.active:
        save_result(ACTIVE, {"of": with_result(ACTIVE, active_labelling(seed, args.out))})
    return 0


if __name__ == "__main__":
    sys.exit(main())
