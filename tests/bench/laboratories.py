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
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import cache
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
from touchdown.backend.config import SimulationSettings, StackSettings, load_simulation
from touchdown.backend.core import FaultError, InputError, Paused, write_atomically
from touchdown.backend.experiments import KINDS
from touchdown.backend.geometry import load_pieces
from touchdown.backend.identification import (
    Recordings,
    identify_bench,
    read_recordings,
    write_identification,
)
from touchdown.backend.identification.stages import Gate, replay_gate
from touchdown.backend.jobs import JobContext, JobSpec, JobStore
from touchdown.backend.learning import use_one_thread
from touchdown.backend.learning.fused import load_fused
from touchdown.backend.runs import (
    PRESS_OF_PLAN,
    CollectRequest,
    RecordingOptions,
    newest_campaign,
    read_plan,
)

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
# Drawn and recorded from this seed on: the first laboratories had no drags.
FACES_FROM, FACES = 50, {"mu": (0.25, 0.5, False), "spread.mu": (0.03, 0.12, False)}
GEL, CONTACT, DRAG = (45, 5, 3), (2, 1, 6), (4, 2, 6)  # presses, per grip, grips per mounting
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
    for key, (low, high, log) in (RANGES | (FACES if seed >= FACES_FROM else {})).items():
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
    bench: SimulationSettings, folder: Path, seed: int, *, drivers: bool = False,
    gel: tuple[int, int, int] = GEL,
) -> None:  # fmt: skip
    """Record the plans of an identification, shortened; continue a campaign that a fault ended."""
    numbers = "count", "probes_per_grip", "grips_per_mounting"
    plans: tuple[dict[str, Any], ...] = (
        {**dict(zip(numbers, gel, strict=True)), "stage": "gel", "ramp_fraction": 0.4},
        {"count": 1, "probes_per_grip": 1, "stage": "rest",
         "rest_s": REST_DRIVERS_S if drivers else REST_S},
        {**dict(zip(numbers, CONTACT, strict=True)), "stage": "contact", "within_mm": 2.0,
         "depth_mm": 1.9, "ramp_fraction": 0.6, "grip_force_n": 4.0},
        {**read_plan("drag").model_dump(include=PRESS_OF_PLAN | {"within_mm"}),
         **dict(zip(numbers, DRAG, strict=True))},
    )[: 4 if seed >= FACES_FROM else 3]  # fmt: skip
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


def recorded_laboratory(
    seed: int, folder: Path, *, drivers: bool = False, gel: tuple[int, int, int] = GEL
) -> Recordings:
    """Return the recordings of a laboratory; record it if ``folder`` does not hold it whole."""
    done = folder / "recorded"
    if not done.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        bench, _ = draw_laboratory(seed, drivers=drivers)
        record_laboratory(bench, folder / "dataset", seed, drivers=drivers, gel=gel)
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
LOSSES, COMES_BACK, CERTIFICATES = "laboratory-losses", "comes-back", "laboratory-certificates"
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
    """Identify a bench from ``MANY`` recorded presses; reading the dataset counts."""
    folder = FOLDER / "time"
    recorded_laboratory(0, folder, gel=(MANY, *GEL[1:]))
    shutil.rmtree(folder / "stages", ignore_errors=True)
    began_cpu = time.process_time()
    with Dataset.open(folder / "dataset", write=False) as dataset:
        recordings = read_recordings(dataset)
    reading = (time.process_time() - began_cpu) / 60.0
    found = identify_bench(recordings, load_simulation(), load_pieces(), folder / "stages")
    minutes = (time.process_time() - began_cpu) / 60.0
    note = f"{found.presses} presses of {found.grips} grips; reading them {reading:.1f} min"
    return [at_most(f"identify, {MANY} presses, one core", minutes, "min", 20.0, note)]


KNOWN = "circle15,circle25,square15"  # bottoms of labelled probes


def write_bench(file: Path, content: Mapping[str, Any]) -> Path:
    """Write the settings of a bench."""
    lines = [f"{key} = {json.dumps(v)}" for key, v in content.items() if not isinstance(v, dict)]
    for group, values in content.items():
        if isinstance(values, dict):
            lines.append(f"[{group}]")
            lines += [f"{key} = {json.dumps(v)}" for key, v in values.items()]
    file.write_text("\n".join(lines) + "\n")
    return file


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
        known = write_identified(place, out, bench)
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


def write_identified(place: str, out: Path, bench: Path) -> dict[str, Any]:
    """Write the identified ``bench`` of a laboratory and its ranges; return the result."""
    # From recordings through the drivers if there are some
    names = f"laboratory-{place}-drivers.json", f"laboratory-{place}.json"
    file = next(out / name for name in names if (out / name).is_file())
    known: dict[str, Any] = json.loads(file.read_text())
    write_bench(bench, known["bench"])
    bench.with_suffix(".json").write_text(json.dumps({"randomisation": known["ranges"]}))
    return known


RISK, CERTIFIED_TRIALS = 0.02, 50  # accepted, as that of the shipped certificate; of each pair


def certified(seed: int, out: Path) -> dict[str, Any]:
    """Make the certificate again for networks adapted to a laboratory, on its identified bench.

    Then count the trials in the laboratory itself, with the settings of the certificate.
    """
    folder = out / f"certified-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    bench = folder / "bench.toml"
    write_identified(str(seed), out, bench)
    how = replace(HIDDEN_ADAPTATION, rule=f":fused.risk={RISK}", trials=CERTIFIED_TRIALS)
    network = folder / "fused.safetensors"
    if not network.is_file():
        adapted(how, bench, folder, None)
    words = ["experiment", "certify", "--model", network, "--bench", bench, "--level", RISK,
             "--executor", "local", "--out", folder / "certify", "--json"]  # fmt: skip
    with redirect_stdout(io.StringIO()):
        assert command_line(list(map(str, words))) == 0
    (counts,) = json.loads((folder / "certify/certify.json").read_text())["attempt"]["counts"]
    use_one_thread()
    there, _ = draw_laboratory(seed, drivers=True)
    trials = Counter(outcomes(how, there, str(network)))
    return {"seed": seed, "certificate": counts, "laboratory": dict(trials)}


@figure("identification")
def certificate_of_laboratory() -> list[Figure]:
    """Judge the certificates in docs/results, which ``main`` adds."""
    figures = []
    for one in stored_results(CERTIFICATES):
        counts, ends = one["certificate"], Counter(one["laboratory"])
        released = ends["placed"] + ends["fell"]
        name = f"laboratory {one['seed']}, adapted networks: "
        note = (f"{counts['unsafe']} of {counts['releases']}; placed {counts['placed']} of "
                f"{counts['scenes']} scenes")  # fmt: skip
        figures += [
            at_most(f"{name}bound of unsafe releases on the identified bench",
                    100 * counts["bound"], "%", 1.0, note),
            stated(f"{name}unsafe of released in the laboratory itself",
                   100 * ends["fell"] / max(released, 1), "%", str(dict(ends))),
        ]  # fmt: skip
    return figures


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
    parser.add_argument("--losses", action="store_true", help="only count the trials of the "
                        "shipped networks in the laboratories")  # fmt: skip
    parser.add_argument("--comes-back", metavar="PLACE", help="success after an adaptation to a "
                        f"laboratory, by its seed, or to {SECOND_WORLD}")  # fmt: skip
    parser.add_argument("--certify", type=int, metavar="SEED", help="make the certificate again "
                        "for networks that are adapted to a laboratory")  # fmt: skip
    parser.add_argument("--trials", type=int, help="of each piece and bottom for --comes-back")
    parser.add_argument("--keep", action="store_true", help="keep the recordings, 100 MB each")
    args = parser.parse_args()
    if args.comes_back is not None:
        of = with_result(COMES_BACK, comes_back(args.comes_back, args.out, args.trials))
        save_result(COMES_BACK, {"of": of})
        return 0
    if args.certify is not None:
        of = with_result(CERTIFICATES, certified(args.certify, args.out))
        save_result(CERTIFICATES, {"of": of})
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
