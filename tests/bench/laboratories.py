"""Hidden laboratories: benches drawn from wide ranges, recorded, identified, and judged.

``python -m tests.bench.laboratories --count 20``. Only this judge knows the drawn values. Results
are added to those in docs/results, by seed, so that parts can run at different times. Recordings
come from ``collect`` on the simulated bench, through the dataset, with fewer images
and fast free moves; with ``--drivers`` from the emulated bench: real drivers on real wires,
in real time. The laboratories share the model of the identification, so this checks for errors, not
for realism. Results of finished laboratories are kept in ``--out``, and with ``--keep`` their
recordings: a laboratory without its result is then identified again from them.
"""

import argparse
import io
import json
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from tests.backend.bench.brisk import brisk_method, on
from tests.bench.experiments import label_elsewhere, recorded_elsewhere
from tests.bench.figures import DATA, Figure, at_least, at_most, figure, stated
from touchdown.backend.annotations import Dataset
from touchdown.backend.bench import EmulatedBench, Session, SimulatedBenchChoice, simulated_session
from touchdown.backend.cli.command_line import main as command_line
from touchdown.backend.config import (
    SimulationSettings,
    StabilitySettings,
    StackSettings,
    TrainingSettings,
    load_simulation,
)
from touchdown.backend.core import FaultError, InputError, Paused, write_atomically
from touchdown.backend.episodes import Split, TrainingRows, join_rows, load_rows
from touchdown.backend.experiments import KINDS
from touchdown.backend.experiments.document import curves_chart
from touchdown.backend.geometry import face_points, load_pieces, true_patch
from touchdown.backend.identification import (
    Recordings,
    identify_bench,
    read_recordings,
    write_identification,
)
from touchdown.backend.identification.stages import Gate, replay_gate
from touchdown.backend.jobs import JobContext, JobSpec, JobStore
from touchdown.backend.learning import load_checkpoint, stable_flags, use_one_thread
from touchdown.backend.learning.fused import load_fused
from touchdown.backend.learning.inference import modality_columns
from touchdown.backend.learning.metrics import CONTACT_LEVEL, iou
from touchdown.backend.learning.training import Trainer, load_network, predict
from touchdown.backend.placement import label_review, shipped_model
from touchdown.backend.runs import CollectRequest, RecordingOptions, newest_campaign

# Setting: low, high, and whether the logarithm is uniform
RANGES: dict[str, tuple[float, float, bool]] = {
    "wrist.white_n": (0.03, 0.2, True),
    "wrist.white_nm": (0.0015, 0.008, True),
    "wrist.drift_n_sqrt_min": (0.004, 0.05, True),
    "wrist.drift_nm_sqrt_min": (0.0002, 0.002, True),
    "wrist.offset_n": (0.05, 0.5, True),
    "wrist.offset_nm": (0.002, 0.025, True),
    "tactile.drift_px_sqrt_s": (0.005, 0.06, True),
    "tactile.jitter_s": (0.0, 0.008, False),
    "tactile.lost_share": (0.0005, 0.003, False),
    "tactile.bias_px": (0.05, 0.7, True),
    "tactile.mm_per_px.0": (0.052, 0.07, False),
    "tactile.mm_per_px.1": (0.052, 0.07, False),
    "tactile.roll_off_mm.0": (5.5, 9.0, False),
    "tactile.roll_off_mm.1": (5.0, 8.0, False),
    "grasp.shear_n_mm": (2.8, 6.5, True),
    "grasp.normal_n_mm": (6.0, 18.0, True),
    "grasp.torsion_nmm_rad": (70.0, 260.0, True),
    "grasp.hysteresis_share": (0.05, 0.3, False),
    "grasp.hysteresis_s": (0.25, 1.0, True),
    "face.foundation_n_mm3": (6.0, 40.0, True),
    "mu_grip": (0.5, 0.95, False),
    "spread.gel": (0.03, 0.12, False),
    "spread.gain": (0.02, 0.08, False),
    "spread.mu_grip": (0.04, 0.12, False),
    "spread.tilt_rad": (0.002, 0.011, True),
    "spread.print_offset_mm": (0.05, 0.25, False),
    "spread.jig_mm": (0.05, 0.25, False),
}
GEL, CONTACT = (45, 5, 3), (2, 1, 6)  # presses, per grip, grips per mounting
REST_S, TRIES = 31.0, 60
REST_DRIVERS_S = 61.0  # a busy computer leaves gaps between the blocks
# Points a side of a cell of 1 mm. Whole cells err by 3 to 5 N·mm in the moments; the press model
# has other ones, so that it does not repeat the errors of the bench.
SUBCELLS = 5
# Slip is judged by five pictures in the middle of a ramp of 0.8 s; a lower rate loses most presses.
RATE_HZ = 18.0


def draw_laboratory(
    seed: int, *, drivers: bool = False
) -> tuple[SimulationSettings, dict[str, float]]:
    """Return the bench of a laboratory and its drawn values; drivers see all images."""
    rng = np.random.default_rng([20, 22, seed])
    content = load_simulation().model_dump(mode="json")
    content["grasp"]["hysteresis"] = True
    content["face"]["subcells"] = SUBCELLS
    if not drivers:
        content["tactile"].update(rate_hz=RATE_HZ, drop_share=0.0)
    truth = {}
    for key, (low, high, log) in RANGES.items():
        value = float(
            np.exp(rng.uniform(np.log(low), np.log(high))) if log else rng.uniform(low, high)
        )
        truth[key] = value
        *groups, last = key.split(".")
        place: Any = content
        for name in groups:
            place = place[name]
        place[int(last) if last.isdigit() else last] = value
    return SimulationSettings.model_validate(content), truth


@contextmanager
def opened(bench: SimulationSettings, *, drivers: bool) -> Iterator[Session]:
    """Open the simulated bench, or the emulated one with its drivers."""
    choice, keep = SimulatedBenchChoice(given=bench), RecordingOptions(None)
    if drivers:
        with EmulatedBench(choice, keep=keep) as emulated:
            yield emulated.session
        return
    session = simulated_session(choice, keep=keep, method=brisk_method())
    yield session
    session.close()


def record_laboratory(
    bench: SimulationSettings, folder: Path, seed: int, *, drivers: bool = False
) -> None:
    """Record the plans of an identification, shortened; continue a campaign that a fault ended."""
    numbers = "count", "probes_per_grip", "grips_per_mounting"
    plans: tuple[dict[str, Any], ...] = (
        {**dict(zip(numbers, GEL, strict=True)), "stage": "gel", "ramp_fraction": 0.4},
        {"count": 1, "probes_per_grip": 1, "stage": "rest",
         "rest_s": REST_DRIVERS_S if drivers else REST_S},
        {**dict(zip(numbers, CONTACT, strict=True)), "stage": "contact", "within_mm": 2.0,
         "depth_mm": 1.9, "ramp_fraction": 0.6, "grip_force_n": 4.0},
    )  # fmt: skip
    common = {"piece": "pot", "bottom": "square15", "person": "judge"}
    with (
        mock.patch("os.fsync"),
        Dataset.open(folder, person="judge") as dataset,
        opened(bench, drivers=drivers) as session,
    ):
        session.dataset = dataset
        # A pause waits for an operator: end the campaign and continue it.
        on(session, Paused, lambda _: session.engine.cancel())
        for number, plan in enumerate(plans):
            request = CollectRequest(**common, seed=100 * seed + number, **plan)
            for _ in range(TRIES):
                with suppress(FaultError):
                    if session.run(request).ending == "finished":
                        break
                session.reset()
                request = replace(request, campaign=newest_campaign(folder) or "")


def judge(estimates: Mapping[str, Any], truth: Mapping[str, float]) -> dict[str, Any]:
    """Return per parameter: true and estimated value, coverage, and sharpness."""
    return {
        key: {
            "true": truth[key], "value": one.value, "sigma": one.sigma,
            "covered": bool(one.low <= truth[key] <= one.high), "sharpness": one.sharpness,
        }
        for key, one in estimates.items()
        if key in truth
    }  # fmt: skip


def recorded_laboratory(seed: int, folder: Path, *, drivers: bool = False) -> Recordings:
    """Return the recordings of a laboratory; record it if ``folder`` does not hold it whole."""
    done = folder / "recorded"
    if not done.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        bench, _ = draw_laboratory(seed, drivers=drivers)
        record_laboratory(bench, folder / "dataset", seed, drivers=drivers)
        done.touch()
    with Dataset.open(folder / "dataset", write=False) as dataset:
        return read_recordings(dataset)


def run_laboratory(
    seed: int, out: Path, *, drivers: bool = False, keep: bool = False
) -> dict[str, Any]:
    """Return the result of one laboratory, from ``out`` if it is there; its parts are kept too."""
    file = out / f"laboratory-{seed}{'-drivers' if drivers else ''}.json"
    if file.is_file():
        found: dict[str, Any] = json.loads(file.read_text())
        return found
    bench, truth = draw_laboratory(seed, drivers=drivers)
    folder = file.with_suffix("")
    recordings = recorded_laboratory(seed, folder, drivers=drivers)
    began_cpu = time.process_time()
    drawn: list[Gate] = []

    def gate(held: Any, fit: Any, nominal: SimulationSettings, *rest: Any) -> Gate:
        drawn.append(replay_gate(held, fit, bench, *rest))
        return replay_gate(held, fit, nominal, *rest)

    with mock.patch("touchdown.backend.identification.stages.replay_gate", gate):
        found_bench = identify_bench(
            recordings, load_simulation(), load_pieces(), folder / "stages"
        )
    result = {
        "seed": seed,
        "accepted": found_bench.gate.accepted,
        "converged": found_bench.converged,
        "share": found_bench.gate.share,
        # What the drawn bench itself leaves: the spread between grippings
        "drawn_share": found_bench.gate.share / drawn[0].share,
        "misfit": found_bench.misfit,
        "presses": found_bench.presses,
        "judged": found_bench.gate.presses,
        "grips": found_bench.gate.grips,
        "identify_cpu_s": round(time.process_time() - began_cpu, 1),
        "parameters": judge({e.key: e for e in found_bench.estimates}, truth),
        "bench": found_bench.settings.model_dump(mode="json", exclude_none=True),
        "ranges": found_bench.ranges(),
    }
    write_atomically(file, json.dumps(result, indent=1).encode())
    if not keep:
        shutil.rmtree(folder)
    return result


def summary(results: list[dict[str, Any]], *, drivers: bool = False) -> dict[str, Any]:
    """Return coverage, sharpness and held-out error over laboratories."""
    cells = [(key, one) for r in results for key, one in r["parameters"].items()]
    by_key = {
        key: [one for name, one in cells if name == key]
        for key in dict.fromkeys(k for k, _ in cells)
    }
    return {
        "laboratories": len(results),
        "recorded_by": f"collect on the {'emulated' if drivers else 'simulated'} bench",
        "coverage_95": float(np.mean([one["covered"] for _, one in cells])),
        "median_sharpness": float(np.median([one["sharpness"] for _, one in cells])),
        "held_out_share": [r["share"] for r in results],
        "drawn_share": [r["drawn_share"] for r in results],
        "median_held_out_share": float(np.median([r["share"] for r in results])),
        "accepted": sum(r["accepted"] for r in results),
        "by_parameter": {
            key: {
                "covered": sum(one["covered"] for one in found), "of": len(found),
                "median_sharpness": float(np.median([one["sharpness"] for one in found])),
            }
            for key, found in by_key.items()
        },
    }  # fmt: skip


FOLDER = Path("output/laboratories")
# Files in docs/results
HIDDEN, THROUGH_DRIVERS = "hidden-laboratories", "laboratory-drivers"
LOSSES, COMES_BACK, ACTIVE = "laboratory-losses", "comes-back", "labels-saved"
MANY = 300  # presses
LOST = 10.0  # points of success; less is no loss that could come back


def stored_results(name: str) -> list[dict[str, Any]]:
    """Return the laboratories of a file in docs/results, none without the file."""
    file = DATA.parent / f"{name}.json"
    return list(json.loads(file.read_text())["of"]) if file.is_file() else []


def with_result(name: str, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the stored laboratories with one more, or in place of that of the same seed."""
    own = {k: v for k, v in result.items() if k not in ("bench", "ranges")}
    kept = [one for one in stored_results(name) if one["seed"] != own["seed"]]
    return sorted([*kept, own], key=lambda one: str(one["seed"]).zfill(3))


@figure("identification")
def hidden_laboratories() -> list[Figure]:
    """Judge the laboratories in docs/results, which ``main`` adds."""
    results = stored_results(HIDDEN)
    if not results:
        raise InputError("There is no result.", HIDDEN, "Run tests.bench.laboratories first.")
    found = summary(results)
    shares = np.array(found["held_out_share"])
    name = f"hidden laboratories ({len(results)}): "
    note = f"accepted: {found['accepted']}"
    return [
        at_least(f"{name}parameters in their 95 % interval", 100 * found["coverage_95"], "%", 85.0),
        at_most(f"{name}median sigma over that of the prior", found["median_sharpness"], "", 0.5),
        at_most(f"{name}held-out error over that of the nominal bench, median",
                100 * float(np.median(shares)), "%", 50.0, note),
        stated(f"{name}held-out error above 50 %", int((shares > 0.5).sum()), "laboratories"),
        stated(f"{name}held-out error of the drawn bench itself, median",
               100 * float(np.median(found["drawn_share"])), "%"),
    ]  # fmt: skip


@figure("identification")
def laboratory_through_drivers() -> list[Figure]:
    """Judge the laboratories in docs/results: real drivers on real wires, in real time."""
    results = stored_results(THROUGH_DRIVERS)
    if not results:
        raise InputError("There is no result.", THROUGH_DRIVERS, "Record with --drivers first.")
    total, name = summary(results), f"hidden laboratories through drivers ({len(results)}): "
    return [
        at_least(f"{name}parameters in their 95 % interval", 100 * total["coverage_95"], "%", 85.0),
        at_most(f"{name}median sigma over that of the prior", total["median_sharpness"], "", 0.5),
        at_most(f"{name}held-out error, worst", 100 * max(total["held_out_share"]), "%", 50.0),
    ]


@figure("identification")
def success_that_comes_back() -> list[Figure]:
    """Judge the adaptations in docs/results, of those places that lost ten points of success."""
    lost = [one for one in stored_results(COMES_BACK) if one["lost_points"] >= LOST]
    if not lost:
        raise InputError("There is no result.", COMES_BACK, "Run --comes-back first.")
    elsewhere = [one for one in lost if one["seed"] == SECOND_WORLD]
    own = [one for one in lost if one not in elsewhere]
    figures = []
    for name, part, limit in (
        (f"hidden laboratories ({len(own)})", own, 50.0), ("second world", elsewhere, 40.0),
    ):  # fmt: skip
        ends = [Counter(), Counter(), Counter()]
        for one in part:
            for total, counts in zip(ends, one["outcomes"].values(), strict=True):
                total.update(counts)
        if part:
            before, after = (end["placed"] - ends[0]["placed"] for end in ends[1:])
            note = ", ".join(f"{arm}: {dict(end)}" for arm, end in zip(
                part[0]["outcomes"], ends, strict=True))  # fmt: skip
            low, high = interval_by_laboratory(part)
            note += f"; 95 %: {low:.1f} to {high:.1f} %" + (
                ", by laboratory" if part is own else ""
            )
            figures.append(at_least(
                f"{name}: success of `fused` that comes back of what was lost",
                100.0 * (1.0 - after / before), "%", limit, note))  # fmt: skip
            figures.append(at_most(
                f"{name}: unsafe of released after the adaptation",
                100.0 * ends[2]["fell"] / max(ends[2]["fell"] + ends[2]["placed"], 1), "%", 5.0,
            ))  # fmt: skip
    return figures


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


def interval_by_laboratory(part: list[dict[str, Any]]) -> NDArray[np.float64]:
    """Return the 95 % interval of the pooled share in percent; one place: that of its trials."""
    if len(part) == 1:
        return 100.0 * np.array(part[0]["interval"])
    ends = [list(one["outcomes"].values()) for one in part]
    placed = np.array([[end.get("placed", 0) for end in of] for of in ends], float)
    rows = np.random.default_rng(0).integers(len(part), size=(2000, len(part)))
    own, before, after = placed[rows].sum(axis=1).T
    share: NDArray[np.float64] = 100.0 * (after - before) / (own - before)
    return np.quantile(share, [0.025, 0.975])


@figure("identification")
def identification_time() -> list[Figure]:
    """Identify a bench from ``MANY`` presses: those of a laboratory, each several times."""
    recordings = recorded_laboratory(0, FOLDER / "time")
    gel = [press for press in recordings.presses if press.stage == "gel"]
    copies = -(-MANY // len(gel))
    many = tuple(
        replace(press, grip=f"{press.grip}-{copy % 3}", uuid=f"{press.uuid}-{copy}")
        for copy in range(copies)
        for press in gel
    )[:MANY]
    slipped = tuple(press for press in recordings.presses if press.stage == "contact")
    stages = FOLDER / "time-stages"
    shutil.rmtree(stages, ignore_errors=True)
    began_cpu = time.process_time()
    identify_bench(
        replace(recordings, presses=(*many, *slipped)), load_simulation(), load_pieces(), stages
    )
    minutes = (time.process_time() - began_cpu) / 60.0
    note = f"{len(gel)} recorded presses, {copies} times; without reading the dataset"
    return [at_most(f"identify, {MANY} presses, one core", minutes, "min", 20.0, note)]


# Patch networks on probes of one laboratory: pot, small network, minutes of one core.
CURVE_LABELS, REPEATS, SIMULATED_PROBES, POOL, TESTED = (0, 50, 200), 3, 3000, 400, 400
SMALL = TrainingSettings(hidden=64, epochs=20, keep="last", patience=100)
TUNING = SMALL.model_copy(update={"learning_rate": 3e-4, "epochs": 10, "batch": 32})
ALONE = SMALL.model_copy(update={"epochs": 40, "batch": 16})
MIXED = 400  # simulated probes beside the labelled ones of a fine-tuning
KNOWN, UNSEEN = "circle15,circle25,square15", "short,long"
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


def write_bench(file: Path, content: Mapping[str, Any]) -> Path:
    """Write the settings of a bench."""
    lines = [f"{key} = {json.dumps(v)}" for key, v in content.items() if not isinstance(v, dict)]
    for group, values in content.items():
        if isinstance(values, dict):
            lines.append(f"[{group}]")
            lines += [f"{key} = {json.dumps(v)}" for key, v in values.items()]
    file.write_text("\n".join(lines) + "\n")
    return file


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


def learning_curves(seed: int, out: Path) -> dict[str, Any]:
    """Test patch networks on one laboratory by the number of its labelled probes.

    Simulation of the nominal and of the identified bench, the latter fine-tuned on labels and some
    simulated probes, and labels alone. ``REPEATS`` draws of the labels and of what is mixed in.
    """
    use_one_thread()
    nominal, pool, test = laboratory_probes(seed, out)
    found = json.loads((out / f"laboratory-{seed}.json").read_text())
    identified = write_bench(out / f"identified-{seed}.toml", found["bench"])
    files = {"nominal": nominal, "identified": identified}
    simulated = {name: simulated_probes(files[name], SIMULATED_PROBES // 3, 1, KNOWN, 10, 2)
                 for name in ("nominal", "identified")}  # fmt: skip
    start = {name: trained(some, SMALL, 0) for name, some in simulated.items()}
    arms = {"nominal simulation": "nominal", "fine-tuned": "identified"}
    rows = [{"arm": arm, "labels": 0, "repeat": 0, **tested(start[name], test)}
            for arm, name in arms.items()]  # fmt: skip
    for repeat in range(REPEATS):
        order = np.random.default_rng(repeat).permutation(len(pool))
        for labels in CURVE_LABELS[1:]:
            own = pool.take(order[:labels])
            tuned = trained(own, TUNING, repeat, start["identified"], simulated["identified"])
            alone = trained(own, ALONE, repeat)
            both = {"fine-tuned": tuned, "laboratory alone": alone}
            rows += [{"arm": arm, "labels": labels, "repeat": repeat, **tested(network, test)}
                     for arm, network in both.items()]  # fmt: skip
    return {"laboratory": seed, "simulated_probes": SIMULATED_PROBES, "tested": len(test),
            "repeats": REPEATS, "rows": rows}  # fmt: skip


def curve_pictures(found: Mapping[str, Any]) -> dict[str, str]:
    """Return the learning curves as SVG, by name of the quantity."""
    pictures = {}
    for quantity, title in (("iou", "IoU"), ("balanced_stability", "balanced stability")):
        curves = {
            arm: np.array([
                np.mean([r[quantity] for r in found["rows"] if (r["arm"], r["labels"]) == (arm, n)]
                        or [np.nan]) for n in CURVE_LABELS])
            for arm in ("nominal simulation", "fine-tuned", "laboratory alone")
        }  # fmt: skip
        constant = curves["nominal simulation"]
        constant[:] = constant[0]
        labels = np.array(CURVE_LABELS, float)
        pictures[quantity] = curves_chart(title, labels, curves, ("labelled probes", ""))
    return pictures


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


RECOVERY_SEED = 48_000_000
SECOND_WORLD = "elsewhere-finite-elements"


@dataclass(frozen=True)
class Adaptation:
    """Trials before and after an adaptation, and its training.

    ``network``: shipped one, which was trained on the preset ``own``, with its ``rule`` of release.
    ``trials`` of each of ``pieces`` and bottom. ``labels``: probes of the place, beside
    a ``share`` of simulated ones.
    """

    network: str
    own: str
    outlines: str
    rule: str
    pieces: tuple[str, ...]
    trials: int
    networks: int
    steps: int
    labels: int = 0
    long_parts: int = 6
    rate: float = 1e-3
    share: float = 0.5

    @property
    def shipped(self) -> str:
        """Path of the shipped network."""
        return str(files("touchdown.resources") / f"models/fused/{self.network}.safetensors")


HIDDEN_ADAPTATION = Adaptation(
    "any", "bench-v2", "any", ":fused.ensemble=mixture:policy.max_probes=12:fused.first_risk=0.004"
    ":fused.risk=0.03:fused.inset_mm=0", ("pot", "barrel", "mushroom"), 10, 2, 200,
)  # fmt: skip
# Only networks for convex outlines can be trained on labelled probes.
SECOND_ADAPTATION = Adaptation(
    "fused", "bench-v1", "convex", "", ("pot",), 30, 1, 300, 200, 4, 2e-4, 0.8
)


def outcomes(
    how: Adaptation, bench: SimulationSettings, network: str, world: str = "bench"
) -> list[str]:
    """Return the outcomes of the trials of a network, by piece, bottom and seed."""
    found = []
    for number, (piece, bottom) in enumerate(product(how.pieces, ("short", "long"))):
        params = {
            "bench": bench.model_dump(mode="json"), "piece": piece, "bottom": bottom,
            "trials": how.trials, "world": world,
            "strategy": f"fused:fused.weights={network}{how.rule}",
            "method": StackSettings().model_dump(mode="json"),
        }  # fmt: skip
        spec = JobSpec("beyond", params, RECOVERY_SEED + 1000 * number)
        answer = KINDS["beyond"](spec, JobContext(Path(), JobStore(Path())))
        found += [trial["outcome"] for trial in answer["trials"]]
    return found


def recovered(own: list[str], before: list[str], after: list[str]) -> dict[str, Any]:
    """Return what comes back of the success lost against the own bench, paired by trial.

    ``interval``: bootstrap over the trials, of the draws with a loss.
    """
    placed = np.array([[o == "placed" for o in part] for part in (own, before, after)], float)
    rows = np.random.default_rng(0).integers(placed.shape[1], size=(2000, placed.shape[1]))
    drawn = placed[:, rows].mean(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        back = (drawn[2] - drawn[1]) / (drawn[0] - drawn[1])
        share = float(np.diff(placed.mean(axis=1)[1:])[0] / (placed[0] - placed[1]).mean())
    fell, stood = after.count("fell"), after.count("placed")
    return {
        "lost_points": 100.0 * float((placed[0] - placed[1]).mean()),
        "comes_back": share if np.isfinite(share) else None,
        "interval": np.quantile(back[drawn[0] > drawn[1]], [0.025, 0.975]).tolist(),
        "unsafe_of_released": fell / max(fell + stood, 1),
        "outcomes": {arm: dict(Counter(part)) for arm, part in
                     (("own bench", own), ("before", before), ("after", after))},
    }  # fmt: skip


def adapted(how: Adaptation, bench: Path, out: Path, labels: Path | None) -> Path:
    """Train the shipped networks further on an identified bench, its ranges, and labelled probes.

    A bench that was refused has no ranges beside it. Returns the file.
    """
    words = ["experiment", "fused", "--bench", bench, "--from", how.shipped,
             "--outlines", how.outlines, "--networks", how.networks, "--parts", 0, "--long-parts",
             how.long_parts, "--steps", how.steps, "--rate", how.rate, "--executor", "serial",
             "--out", out, "--json"]  # fmt: skip
    ranges = bench.with_suffix(".json")
    words += ["--ranges", ranges] if ranges.is_file() else []
    words += ["--data", labels, "--mix-share", how.share] if labels else []
    with redirect_stdout(io.StringIO()):
        assert command_line(list(map(str, words))) == 0
    return out / "fused.safetensors"


def add_loss(seed: int) -> None:
    """Count the trials of the shipped networks in one laboratory, and on their own bench."""
    use_one_thread()
    how = HIDDEN_ADAPTATION
    there, _ = draw_laboratory(seed, drivers=True)
    own = own_outcomes(how)
    before = outcomes(how, there, how.shipped)
    counted = {"own": dict(Counter(own)), "there": dict(Counter(before))}
    lost = 100.0 * (own.count("placed") - before.count("placed")) / len(own)
    of = with_result(LOSSES, {"seed": seed, "lost_points": lost, **counted})
    save_result(LOSSES, {"of": of})


@cache
def own_outcomes(how: Adaptation) -> list[str]:
    """Return the outcomes of the shipped networks on the bench of their training."""
    return outcomes(how, load_simulation(preset=how.own), how.shipped)


def comes_back(place: str, out: Path, trials: int | None = None) -> dict[str, Any]:
    """Adapt the shipped networks to a laboratory, by its seed, or to the second world.

    Trials on the bench of their training, and in the place before and after. ``trials``: of each
    piece and bottom, in place of the usual number.
    """
    use_one_thread()
    folder, began_s, times = out / f"adapted-{place}", time.process_time(), {}
    folder.mkdir(parents=True, exist_ok=True)
    bench, labels = folder / "bench.toml", None
    if place == SECOND_WORLD:
        how, world, labels = SECOND_ADAPTATION, place, folder / "labels"
        how = replace(how, trials=trials or how.trials)
        there = load_simulation(preset=how.own)
        recordings = recorded_elsewhere(there, 1)
        found = identify_bench(recordings, there, load_pieces(), folder / "stages")
        facts: dict[str, Any] = {"accepted": found.gate.accepted, "share": found.gate.share,
                                 "misfit": found.misfit, "used": list(found.used)}  # fmt: skip
        if found.gate.accepted:
            write_identification(found, bench, place)
        else:
            write_bench(bench, there.model_dump(mode="json", exclude_none=True))
        if not labels.is_dir():
            label_elsewhere(there, how.labels, labels, KNOWN.split(","))
    else:
        how, world = HIDDEN_ADAPTATION, "bench"
        how = replace(how, trials=trials or how.trials)
        there, _ = draw_laboratory(int(place), drivers=True)
        # From recordings through the drivers if there are some
        names = f"laboratory-{place}-drivers.json", f"laboratory-{place}.json"
        file = next(out / name for name in names if (out / name).is_file())
        known = json.loads(file.read_text())
        write_bench(bench, known["bench"])
        bench.with_suffix(".json").write_text(json.dumps({"randomisation": known["ranges"]}))
        facts = {key: known[key] for key in ("accepted", "share", "misfit")}
    times["identify"] = time.process_time() - began_s
    network = adapted(how, bench, folder, labels)
    facts["training"] = load_fused(network).card.metrics
    times["train"] = time.process_time() - began_s
    sys.stderr.write(f"{facts}, {times}\n")
    after = kept(
        folder / f"after-{how.trials}.json", lambda: outcomes(how, there, str(network), world)
    )
    before = outcomes_before(how, there, world, folder)
    times["trials"] = time.process_time() - began_s
    return {
        "seed": place, "network": how.network, "pieces": list(how.pieces), "labels": how.labels,
        "identified": facts, **recovered(*before, after), "cpu_s_at_end_of": times,
    }  # fmt: skip


def outcomes_before(
    how: Adaptation, there: SimulationSettings, world: str, folder: Path
) -> tuple[list[str], list[str]]:
    """Return the outcomes on the bench of the networks, and in the place before their training."""
    return (
        kept(folder / f"own-{how.trials}.json", lambda: own_outcomes(how)),
        kept(
            folder / f"before-{how.trials}.json", lambda: outcomes(how, there, how.shipped, world)
        ),
    )


def kept(file: Path, make: Callable[[], list[Any]]) -> list[Any]:
    """Return what ``file`` holds, or what ``make`` returns, and keep it there."""
    if not file.is_file():
        write_atomically(file, json.dumps(make()).encode())
    found: list[Any] = json.loads(file.read_text())
    return found


def save_result(name: str, found: Mapping[str, Any]) -> None:
    """Write a result to docs/results, and to standard output."""
    text = json.dumps({**found, "seconds": round(time.process_time(), 1)}, indent=1) + "\n"
    write_atomically(DATA.parent / f"{name}.json", text.encode())
    sys.stdout.write(text)


def main() -> int:
    """Run laboratories and print their summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=FOLDER, metavar="FOLDER")
    parser.add_argument("--drivers", action="store_true", help="record on the emulated bench")
    parser.add_argument("--curves", type=int, metavar="SEED", help="learning curves on a "
                        "laboratory that was identified, into docs/results")  # fmt: skip
    parser.add_argument("--active", type=int, nargs="+", default=[], metavar="SEED", help="labels "
                        "saved by the queue, in each of these laboratories")  # fmt: skip
    parser.add_argument("--losses", action="store_true", help="only count the trials of the "
                        "shipped networks in the laboratories")  # fmt: skip
    parser.add_argument("--comes-back", metavar="PLACE", help="success after an adaptation to a "
                        f"laboratory, by its seed, or to {SECOND_WORLD}")  # fmt: skip
    parser.add_argument("--trials", type=int, help="of each piece and bottom for --comes-back")
    parser.add_argument("--keep", action="store_true", help="keep the recordings, 100 MB each")
    args = parser.parse_args()
    if args.curves is not None:
        found = learning_curves(args.curves, args.out)
        save_result("learning-curves", found)
        for name, picture in curve_pictures(found).items():
            write_atomically(DATA.parent / f"learning-curves-{name}.svg", picture.encode())
        return 0
    if args.comes_back is not None:
        of = with_result(COMES_BACK, comes_back(args.comes_back, args.out, args.trials))
        save_result(COMES_BACK, {"of": of})
        return 0
    for seed in args.active:
        save_result(ACTIVE, {"of": with_result(ACTIVE, active_labelling(seed, args.out))})
    if args.active:
        return 0
    for seed in range(args.first, args.first + args.count):
        if args.losses:
            add_loss(seed)
            continue
        last = run_laboratory(seed, args.out, drivers=args.drivers, keep=args.keep)
        covered = [one["covered"] for one in last["parameters"].values()]
        sys.stderr.write(
            f"laboratory {seed}: share {last['share']:.2f} (drawn bench "
            f"{last['drawn_share']:.2f}), misfit {last['misfit']:.2f}, "
            f"{sum(covered)} of {len(covered)} in their interval, converged: {last['converged']}, "
            f"identified in {last['identify_cpu_s']} s of CPU\n"
        )
        name = THROUGH_DRIVERS if args.drivers else HIDDEN
        of = with_result(name, last)
        save_result(name, {**summary(of, drivers=args.drivers), "of": of})
    return 0


if __name__ == "__main__":
    sys.exit(main())
