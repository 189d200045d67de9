"""``touchdown train``: train a contact-patch model in a child process, or several of a sweep."""

from __future__ import annotations

import argparse
import json
import shutil
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from touchdown.backend.cli.experiment import add_device, add_executor_arguments, run_jobs
from touchdown.backend.cli.output import VerbOutput, check_output, progress_lines
from touchdown.backend.config import TrainingSettings
from touchdown.backend.core import InputError, disk_errors, make_folder
from touchdown.backend.jobs import JobStore

if TYPE_CHECKING:
    from pydantic import BaseModel

    from touchdown.backend.learning import TrainingJob

SWEPT = (
    "modality", "epochs", "batch", "optimiser", "learning_rate", "precision", "divide_series",
    "seed",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    usual = TrainingSettings()
    add = parser.add_argument
    add("data", type=Path, help="a dataset, or the folder that 'touchdown simulate --out' wrote")
    add("--piece", help="grasped piece (default: the only one in the data)")
    add("--labels", choices=("approved", "submitted", "drafts"), default="approved",
        help="which labels of a dataset count: approved ones; also those that wait for review; "
        "also those measured by a simulated bench")  # fmt: skip
    add("--divide-series", action="store_true", help="hold out whole grips where there are fewer "
        "than 30 mountings; the figures are then too good, because both sides share the errors of "
        "a mounting (default: whole series)")  # fmt: skip
    add("--from", type=Path, dest="pretrained", metavar="CHECKPOINT",
        help="model file to fine-tune; it sets sizes, modality and normalisation")  # fmt: skip
    add("--mix", type=Path, metavar="DATA", help="data of which episodes join the training side")
    add("--mix-share", type=float, default=0.5, help="its share of that side")
    add("--modality", choices=("FT", "Tac", "FT+Tac"), help="inputs of the model: wrench, markers "
        "or both (default: those of --from, else both)")  # fmt: skip
    add("--epochs", type=int, default=usual.epochs, help="epochs; the best weights are kept")
    add("--batch", type=int, default=usual.batch, help="episodes a step")
    add("--optimiser", choices=("Adam", "Muon"), default=usual.optimiser,
        help="Muon needs fewer epochs, for example with --learning-rate 3e-3 "
        "--epochs 8")  # fmt: skip
    add("--learning-rate", type=float, help="step of the optimiser (default: 1e-3, --from: 1e-4)")
    add("--seed", type=int, default=usual.seed, help="of initial weights, order and split")
    add("--precision", choices=("float32", "bfloat16"), default=usual.precision,
        help="of the products of a step; bfloat16 halves the time of an epoch on processors that "
        "support it, with a higher loss, and is refused on others")  # fmt: skip
    add("--threads", type=int, help="processor threads, at most the free cores; the number changes "
        "the last digits of the result (default: 2 where there are two cores)")  # fmt: skip
    add_device(parser)
    add("--out", type=Path,
        help="model file (default: ./<piece>.safetensors, or <checkpoint>-tuned)")  # fmt: skip
    add("--resume", action="store_true", help="resume an interrupted training of the same model")
    add("--sweep", action="append", default=[], metavar="NAME=VALUE,...",
        help="train a model for each value of a setting, such as learning-rate=1e-3,3e-4, and for "
        "each combination if given again; --out is the one of highest validation IoU")  # fmt: skip
    add_executor_arguments(parser)


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Train; return 0 if the model is written. Ctrl-C keeps finished epochs for ``--resume``."""
    # Imported here so that `touchdown --help` starts without torch.
    from touchdown.backend.episodes import group_noun
    from touchdown.backend.learning import (
        TrainingCancelled,
        TrainingEpoch,
        TrainingFinished,
        TrainingLoaded,
        load_card,
        pretraining_text,
        run_training,
    )

    if args.sweep:
        return _sweep(args, screen)
    job = _training_job(args)
    curve: list[dict[str, object]] = []
    answer: dict[str, object] = {}
    with screen.progress(f"Training {args.piece or 'model'}", args.epochs) as advance:

        def show(report: BaseModel) -> None:
            nonlocal answer
            match report:
                case TrainingLoaded():
                    kept = group_noun(report.kept_together)
                    screen.say(
                        f"{report.episodes} episodes of {report.piece}, {report.held_out} held out "
                        f"for validation ({kept}), {report.points} points, "
                        f"{report.parameters:,} parameters, base rate {report.base_rate:.3f}"
                    )
                    answer |= report.model_dump(mode="json", exclude={"kind", "done"})
                case TrainingEpoch():
                    losses = f"{report.train_loss:.4f} / {report.validation_loss:.4f}"
                    words = f"loss {losses}  IoU {100 * report.iou:.1f} %"
                    advance(report.epoch, words)
                    screen.say(f"epoch {report.epoch:3d}/{report.epochs}  {words}")
                    exclude = {"kind", "epochs", "reliability"}
                    curve.append(report.model_dump(mode="json", exclude=exclude))
                case TrainingFinished():
                    screen.say(
                        f"{report.out}: epoch {report.best_epoch}, validation IoU "
                        f"{100 * report.iou:.1f} %, point accuracy "
                        f"{100 * report.point_accuracy:.1f} %, {report.seconds:.0f} s"
                    )
                    if text := pretraining_text(load_card(report.out)):
                        screen.say(text)
                    if report.best_epoch == 0:
                        screen.say("No epoch was better: the weights are those of that model.")
                    answer |= report.model_dump(mode="json", exclude={"kind"})
                case TrainingCancelled():
                    screen.say(f"Cancelled after epoch {report.done}; continue with --resume.")
                    answer |= {"cancelled": True, "done": report.done}

        run_id = run_training(job, show, screen.say, progress_lines())
    if run_id is not None:
        answer["run"] = run_id
    screen.result({**answer, "curve": curve})
    return 1 if "cancelled" in answer else 0


def _training_job(args: argparse.Namespace, **changed: object) -> TrainingJob:
    from touchdown.backend.learning import make_training_job

    options = ("labels", "resume", "threads", "device", "pretrained", "mix", "mix_share")
    stem = f"{args.pretrained.stem}-tuned" if args.pretrained else args.piece or "model"
    out = args.out or Path(f"{stem}.safetensors")
    check_output(out, ".safetensors")
    return make_training_job(
        args.data,
        args.piece,
        out,
        {name: getattr(args, name) for name in SWEPT} | changed,
        **{name: getattr(args, name) for name in options},
    )


def _parse(value: str) -> object:
    with suppress(ValueError):
        return json.loads(value)
    return value


def _variants(sweep: list[str]) -> list[dict[str, object]]:
    """Return the settings of each combination; raises ``InputError`` for an unknown setting."""
    listed: dict[str, list[object]] = {}
    for text in sweep:
        name, _, values = text.partition("=")
        if (name := name.replace("-", "_")) not in SWEPT or not values:
            fix = f"Give NAME=VALUE,... with one of: {', '.join(SWEPT).replace('_', '-')}."
            raise InputError(f"'{text}' is no setting with values.", "--sweep", fix)
        listed[name] = [_parse(value) for value in values.split(",")]
    return [dict(zip(listed, chosen, strict=True)) for chosen in product(*listed.values())]


def _sweep(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Train the variants as jobs; return 0 if all are trained and the best one is written."""
    from touchdown.backend.learning import MODEL, train_variant, variant_job

    if args.resume:
        fix = "Repeat the call without it; finished models of a sweep are kept."
        raise InputError("A sweep continues by itself.", "--resume", fix)
    args.threads = args.threads or 1
    variants = _variants(args.sweep)
    trainings = [_training_job(args, **chosen) for chosen in variants]
    jobs = [variant_job(training) for training in trainings]
    names = {job.id: " ".join(f"{k}={v}" for k, v in chosen.items())
             for job, chosen in zip(jobs, variants, strict=True)}  # fmt: skip
    out = trainings[0].out
    store = JobStore(out.with_suffix(".sweep"))
    make_folder(store.root)
    failed = run_jobs(
        args, screen, store, {"variant": train_variant}, jobs,
        lambda job: (names[job.id], job.params["settings"]["epochs"]),
    )  # fmt: skip
    columns = ("iou", "point_accuracy", "best_epoch", "seconds")
    ends = {job.id: store.result(job.id) for job in jobs if store.has(job.id)}
    order = sorted(ends, key=lambda name: -float(ends[name]["iou"]))
    rows = [{"model": names[i]} | {k: round(ends[i][k], 4) for k in columns} for i in order]
    screen.table("Sweep", ("model", *columns), *(map(str, row.values()) for row in rows))
    if complete := len(ends) == len(names):
        model = store.folder(order[0]) / MODEL
        with disk_errors("The model cannot be written", out, "Name another file."):
            for path in (model, model.with_suffix(".json")):
                shutil.copyfile(path, out.with_suffix(path.suffix))
        screen.say(f"{out}: {names[order[0]]}")
    screen.result({
        "sweep": rows, "jobs": len(names), "missing": len(names) - len(ends), "failed": failed,
        "out": str(out) if complete else None,
    })  # fmt: skip
    return 1 if failed else 0
