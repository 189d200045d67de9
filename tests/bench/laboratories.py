"""Hidden laboratories: benches drawn from wide ranges, recorded, identified, and judged.

``python -m tests.bench.laboratories --count 20 --out FOLDER``. Only this judge knows the drawn
values. Recordings come from ``collect`` on the simulated bench, through the dataset, with half the
usual images and fast free moves. The laboratories share the model of the identification, so this
checks for errors, not for realism. Finished laboratories are kept in ``FOLDER``.
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.backend.bench.brisk import RATE_HZ, brisk_method
from touchdown.backend.annotations import Dataset
from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.config import SimulationSettings, load_simulation
from touchdown.backend.geometry import load_pieces
from touchdown.backend.identification import identify_bench, read_recordings
from touchdown.backend.runs import CollectRequest, RecordingOptions

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
GEL, CONTACT = (36, 4, 3), (2, 1, 6)  # presses, per grip, grips per mounting
REST_S = 31.0


def draw_laboratory(seed: int) -> tuple[SimulationSettings, dict[str, float]]:
    """Return the bench of a laboratory and its drawn values."""
    rng = np.random.default_rng([20, 22, seed])
    content = load_simulation().model_dump(mode="json")
    content["grasp"]["hysteresis"] = True
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


def record_laboratory(bench: SimulationSettings, folder: Path, seed: int) -> None:
    """Record the plans of an identification, shortened."""
    common = {"piece": "pot", "bottom": "square15", "person": "judge"}
    gel = dict(zip(("count", "probes_per_grip", "grips_per_mounting"), GEL, strict=True))
    slip = dict(zip(("count", "probes_per_grip", "grips_per_mounting"), CONTACT, strict=True))
    with mock.patch("os.fsync"), Dataset.open(folder, person="judge") as dataset:
        for number, asked in enumerate((
            {**gel, "stage": "gel", "ramp_fraction": 0.4},
            {"count": 1, "probes_per_grip": 1, "stage": "rest", "rest_s": REST_S},
            {**slip, "stage": "contact", "within_mm": 2.0, "depth_mm": 1.9, "ramp_fraction": 0.6,
             "grip_force_n": 4.0},
        )):  # fmt: skip
            choice = SimulatedBenchChoice(given=bench)
            session = simulated_session(choice, keep=RecordingOptions(None), method=brisk_method())
            session.dataset = dataset
            session.run(CollectRequest(**common, seed=100 * seed + number, **asked))  # type: ignore[arg-type]
            session.close()


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


def run_laboratory(seed: int, out: Path) -> dict[str, Any]:
    """Return the result of one laboratory, from ``out`` if it is there."""
    file = out / f"laboratory-{seed}.json"
    if file.is_file():
        found: dict[str, Any] = json.loads(file.read_text())
        return found
    bench, truth = draw_laboratory(seed)
    folder = Path(tempfile.mkdtemp(prefix="laboratory"))
    try:
        began = time.process_time()
        record_laboratory(bench, folder / "dataset", seed)
        recorded = time.process_time()
        with Dataset.open(folder / "dataset", write=False) as dataset:
            recordings = read_recordings(dataset)
        found_bench = identify_bench(
            recordings, load_simulation(), load_pieces(), folder / "stages"
        )
        result = {
            "seed": seed,
            "accepted": found_bench.gate.accepted,
            "share": found_bench.gate.share,
            "misfit": found_bench.misfit,
            "record_cpu_s": round(recorded - began, 1),
            "identify_cpu_s": round(time.process_time() - recorded, 1),
            "parameters": judge({e.key: e for e in found_bench.estimates}, truth),
        }
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(result, indent=1))
    return result


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return coverage, sharpness and held-out error over laboratories."""
    cells = [(key, one) for r in results for key, one in r["parameters"].items()]
    by_key = {
        key: [one for name, one in cells if name == key]
        for key in dict.fromkeys(k for k, _ in cells)
    }
    return {
        "laboratories": len(results),
        "recorded_by": "collect on the simulated bench, through the dataset",
        "coverage_95": float(np.mean([one["covered"] for _, one in cells])),
        "median_sharpness": float(np.median([one["sharpness"] for _, one in cells])),
        "held_out_share": [r["share"] for r in results],
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


def main() -> int:
    """Run laboratories and print their summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    args = parser.parse_args()
    results = []
    for seed in range(args.first, args.first + args.count):
        results.append(run_laboratory(seed, args.out))
        last = results[-1]
        sys.stderr.write(
            f"laboratory {seed}: share {last['share']:.2f}, recorded in {last['record_cpu_s']} s, "
            f"identified in {last['identify_cpu_s']} s of CPU\n"
        )
    text = json.dumps(summary(results), indent=1)
    (args.out / "summary.json").write_text(text + "\n")
    sys.stdout.write(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
