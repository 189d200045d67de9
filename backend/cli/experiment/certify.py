"""``touchdown experiment certify``: the certificate of a network on fresh scenes."""

from __future__ import annotations

import argparse
from pathlib import Path

from touchdown.backend.cli.experiment.campaign import UNWRITTEN, ExperimentRun, Json, write_json
from touchdown.backend.core import InputError, disk_errors, package_version
from touchdown.backend.experiments import LEAST_SCENES, PIECES, Certification

KEPT = "Free some space, or copy the model to another folder; finished jobs are kept."


def add_certify_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``certify``."""
    group = parser.add_argument_group("certify")
    group.add_argument("--model", type=Path, metavar="FILE", help="network of 'fused' (default: "
                       "the one that ships); the certificate and the log of attempts lie "
                       "beside it")  # fmt: skip
    group.add_argument("--level", default="", metavar="RISK", help="accepted risk, chosen before "
                       "on other scenes; several separated by commas share the error")  # fmt: skip
    group.add_argument("--scenes", type=int, default=LEAST_SCENES, metavar="N", help="fresh "
                       f"scenes of each level, at least {LEAST_SCENES:,}")  # fmt: skip


def run_certify(run: ExperimentRun) -> Json:
    """Run an attempt, write its counts to the log, and the certificate if its bound holds.

    Raises ``InputError`` for a missing level or too few scenes.
    """
    # Imported here so that `--help` starts without torch.
    from touchdown.backend.learning.fused import (
        AttemptLog,
        attempts_path,
        certificate_of_attempt,
        shipped_path,
        write_certificate,
    )

    screen = run.screen
    plan = _plan(run, run.args.model or shipped_path())
    log = AttemptLog(attempts_path(plan.weights))
    attempt = plan.begin(log)
    screen.say(
        f"Attempt {attempt.number}, error {100 * attempt.error:.3g} % for each risk, seeds from "
        f"{attempt.seed}. It is spent, whatever comes out."
    )
    run.run(plan.jobs(attempt))
    counts = plan.counts(attempt, run.store)
    file = None
    if counts and attempt.state == "begun":
        attempt = log.closed(attempt, counts)
        found = certificate_of_attempt(attempt, simulated=True, pieces=PIECES)
        # The log last: an attempt that is interrupted here is continued.
        with disk_errors(UNWRITTEN, plan.weights.parent, KEPT):
            if found is not None:
                file = write_certificate(plan.weights.parent, plan.weights.stem, found)
        log.append(attempt)
        screen.say(
            "The bound exceeds 1 %: no certificate." if found is None
            else f"Certificate: {found.summary()}. It is in {file}."
        )  # fmt: skip
    for level in counts:
        screen.say(
            f"At a risk of {100 * level.risk:g} %: {level.unsafe:,} of {level.releases:,} releases "
            f"unsafe, at most {100 * level.bound:.2f} %; {level.placed:,} of {level.scenes:,} "
            f"scenes placed, harm in {level.harmed:,}."
        )
    answer = {"attempt": attempt.model_dump(mode="json")}
    path = run.args.out / "certify.json"
    write_json(path, answer)
    certificate = None if file is None else str(file)
    return {"file": str(path), "certificate": certificate, **run.counts(), **answer}


def _plan(run: ExperimentRun, weights: Path) -> Certification:
    args, bench = run.args, run.bench()
    try:
        risks = tuple(float(text) for text in args.level.split(","))
        if not all(0.0 < risk < 1.0 for risk in risks) or len(set(risks)) < len(risks):
            raise ValueError
    except ValueError as error:
        raise InputError(
            "A certificate is of a risk that was chosen before.",
            "--level",
            "Give a probability between 0 and 1, such as 0.03, or several different ones.",
        ) from error
    if args.scenes < LEAST_SCENES:
        raise InputError(
            f"{args.scenes} scenes are too few.", "--scenes", f"Give at least {LEAST_SCENES}."
        )
    name, code = args.bench.stem if args.bench else bench.preset, package_version("touchdown")
    return Certification(bench, name, weights.resolve(), risks, args.scenes, code)
