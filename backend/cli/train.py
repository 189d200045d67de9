"""``touchdown train``: train a contact-patch model in a child process."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.config import TrainingSettings, parse_settings
from touchdown.backend.core import InputError

if TYPE_CHECKING:
    from touchdown.backend.learning import TrainingFinished, TrainingLoaded


NAME = "train"
HELP = "train a contact-patch model"
JSON_VERSION = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    _add_data(parser)
    _add_training(parser, TrainingSettings())
    parser.add_argument(
        "--threads",
        type=int,
        help="processor threads, as many as there are free cores; another number gives other last "
        "digits (default: 2 where there are two cores)",
    )
    add_device(parser)
    parser.add_argument(
        "--out", type=Path, help="model file (default: <piece>.safetensors in the present folder)"
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on with an interrupted training of the same model"
    )


def add_device(parser: argparse.ArgumentParser) -> None:
    """Declare ``--device``."""
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="what trains: the graphics processor if torch finds one, or the one that is named "
        "(default: %(default)s)",
    )


def _add_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "data", type=Path, help="a dataset, or the folder that 'touchdown simulate --out' wrote"
    )
    parser.add_argument("--piece", help="grasped piece (default: the only one in the data)")
    parser.add_argument(
        "--labels",
        choices=("approved", "submitted", "drafts"),
        default="approved",
        help="which labels of a dataset count: approved ones; also those that wait for review; "
        "also what a simulated bench noted itself (default: %(default)s)",
    )
    parser.add_argument(
        "--divide-series",
        action="store_true",
        help="hold out whole grips where there are fewer than 30 mountings: figures are then too "
        "good, as validation knows the errors of the mounting (default: whole series)",
    )


def _add_training(parser: argparse.ArgumentParser, defaults: TrainingSettings) -> None:
    parser.add_argument(
        "--modality",
        choices=("FT", "Tac", "FT+Tac"),
        default=defaults.modality,
        help="what the model sees: wrench, markers or both (default: %(default)s)",
    )
    parser.add_argument(
        "--epochs",
        type=int,
        default=defaults.epochs,
        help="passes over the training episodes; the best is kept (default: %(default)s)",
    )
    parser.add_argument(
        "--batch", type=int, default=defaults.batch, help="episodes a step (default: %(default)s)"
    )
    parser.add_argument(
        "--learning-rate",
        type=float,
        default=defaults.learning_rate,
        help="step size of the optimiser (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=defaults.seed,
        help="of first weights, order and split (default: %(default)s)",
    )
    parser.add_argument(
        "--precision",
        choices=("float32", "bfloat16"),
        default=defaults.precision,
        help="of the products of a step; bfloat16 halves the time where the processor computes in "
        "it, and is refused elsewhere (default: %(default)s)",
    )


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Train; 0 when the model is written. Ctrl-C keeps the finished epochs for ``--resume``."""
    # Imported here so that `touchdown --help` starts without torch.
    from touchdown.backend.learning import (
        TrainingCancelled,
        TrainingEpoch,
        TrainingFinished,
        TrainingJob,
        TrainingLoaded,
        TrainingProcess,
        default_threads,
        job_in_run,
        record_report,
        record_training,
    )

    settings = {
        "modality": args.modality,
        "epochs": args.epochs,
        "batch": args.batch,
        "learning_rate": args.learning_rate,
        "precision": args.precision,
        "divide_series": args.divide_series,
        "seed": args.seed,
    }
    job = {
        "data": args.data.resolve(),
        "piece": args.piece,
        "out": _writable((args.out or Path(f"{args.piece or 'model'}.safetensors")).resolve()),
        "settings": parse_settings(TrainingSettings, settings, "arguments"),
        "labels": args.labels,
        "resume": args.resume,
        "threads": default_threads() if args.threads is None else args.threads,
        "device": args.device,
    }
    curve: list[dict[str, object]] = []
    answer: dict[str, object] = {"version": JSON_VERSION}
    asked = parse_settings(TrainingJob, job, "arguments")
    with (
        record_training(asked, screen.say) as record,
        TrainingProcess(job_in_run(record, asked)) as training,
        screen.progress(f"Training {args.piece or 'model'}", args.epochs) as advance,
    ):
        for report in training.reports():
            if record is not None:
                record_report(record, report)
            match report:
                case TrainingLoaded():
                    screen.say(_loaded(report))
                    answer |= report.model_dump(mode="json", exclude={"kind", "done"})
                case TrainingEpoch():
                    words = (
                        f"loss {report.train_loss:.4f} / {report.validation_loss:.4f}  "
                        f"IoU {100 * report.iou:.1f} %"
                    )
                    advance(report.epoch, words)
                    screen.say(f"epoch {report.epoch:3d}/{report.epochs}  {words}")
                    exclude = {"kind", "epochs", "reliability"}
                    curve.append(report.model_dump(mode="json", exclude=exclude))
                case TrainingFinished():
                    screen.say(_finished(report))
                    answer |= report.model_dump(mode="json", exclude={"kind"})
                case TrainingCancelled():
                    screen.say(f"Cancelled after epoch {report.done}; go on with --resume.")
                    answer |= {"cancelled": True, "done": report.done}
    if record is not None:
        answer["run"] = record.uuid
    screen.result({**answer, "curve": curve})
    return 1 if "cancelled" in answer else 0


def _loaded(report: TrainingLoaded) -> str:
    from touchdown.backend.episodes import group_noun

    return (
        f"{report.episodes} episodes of {report.piece}, {report.held_out} held out "
        f"for validation ({group_noun(report.kept_together)}), {report.points} points, "
        f"{report.parameters:,} parameters, base rate {report.base_rate:.3f}"
    )


def _finished(report: TrainingFinished) -> str:
    return (
        f"{report.out}: epoch {report.best_epoch}, validation IoU "
        f"{100 * report.iou:.1f} %, point accuracy "
        f"{100 * report.point_accuracy:.1f} %, {report.seconds:.0f} s"
    )


def _writable(out: Path) -> Path:
    """Return ``out``; ``InputError`` if no file can be written there, before hours of training."""
    if out.is_dir():
        raise InputError("This is a folder, not a file.", str(out), "Name a .safetensors file.")
    folder = next(place for place in out.parents if place.exists())
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"touchdown")
    except OSError as error:
        raise InputError(
            f"The model cannot be written there: {error.strerror or 'not writable'}.",
            str(folder),
            "Name a file in a folder that you may write to (--out).",
        ) from error
    return out
