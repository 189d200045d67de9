"""``touchdown train``: train a contact-patch model in a child process."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from touchdown.backend.cli.output import VerbOutput, progress_lines
from touchdown.backend.config import TrainingSettings

if TYPE_CHECKING:
    from pydantic import BaseModel


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    usual = TrainingSettings()
    parser.add_argument(
        "data", type=Path, help="a dataset, or the folder that 'touchdown simulate --out' wrote"
    )
    parser.add_argument("--piece", help="grasped piece (default: the only one in the data)")
    parser.add_argument(
        "--labels", choices=("approved", "submitted", "drafts"), default="approved",
        help="which labels of a dataset count: approved ones; also those that wait for review; "
        "also those measured by a simulated bench",
    )  # fmt: skip
    parser.add_argument(
        "--divide-series", action="store_true",
        help="hold out whole grips where there are fewer than 30 mountings; the figures are then "
        "too good, because both sides share the errors of a mounting (default: whole series)",
    )  # fmt: skip
    parser.add_argument(
        "--from", type=Path, dest="pretrained", metavar="CHECKPOINT",
        help="model file to fine-tune; it sets sizes, modality and normalisation",
    )  # fmt: skip
    parser.add_argument(
        "--mix", type=Path, metavar="DATA", help="data of which episodes join the training side"
    )
    parser.add_argument("--mix-share", type=float, default=0.5, help="its share of that side")
    parser.add_argument(
        "--modality", choices=("FT", "Tac", "FT+Tac"),
        help="inputs of the model: wrench, markers or both (default: those of --from, else both)",
    )  # fmt: skip
    parser.add_argument(
        "--epochs", type=int, default=usual.epochs, help="epochs; the best weights are kept"
    )
    parser.add_argument("--batch", type=int, default=usual.batch, help="episodes a step")
    parser.add_argument(
        "--learning-rate", type=float, help="step of the optimiser (default: 1e-3, --from: 1e-4)"
    )
    parser.add_argument(
        "--seed", type=int, default=usual.seed, help="of initial weights, order and split"
    )
    parser.add_argument(
        "--precision", choices=("float32", "bfloat16"), default=usual.precision,
        help="of the products of a step; bfloat16 halves the time on processors that support it, "
        "and is refused on others",
    )  # fmt: skip
    parser.add_argument(
        "--threads", type=int,
        help="processor threads, at most the free cores; the number changes the last digits of the "
        "result (default: 2 where there are two cores)",
    )  # fmt: skip
    add_device(parser)
    parser.add_argument(
        "--out",
        type=Path,
        help="model file (default: ./<piece>.safetensors, or <checkpoint>-tuned)",
    )
    parser.add_argument(
        "--resume", action="store_true", help="resume an interrupted training of the same model"
    )


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the argument ``--device``."""
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto",
        help="cpu, cuda, or auto: a graphics processor if torch finds one",
    )  # fmt: skip


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
        make_training_job,
        pretraining_text,
        run_training,
    )

    names = ("modality", "epochs", "batch", "learning_rate", "precision", "divide_series", "seed")
    options = ("labels", "resume", "threads", "device", "pretrained", "mix", "mix_share")
    stem = f"{args.pretrained.stem}-tuned" if args.pretrained else args.piece or "model"
    job = make_training_job(
        args.data,
        args.piece,
        args.out or Path(f"{stem}.safetensors"),
        {name: getattr(args, name) for name in names},
        **{name: getattr(args, name) for name in options},
    )
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
                    words = (
                        f"loss {report.train_loss:.4f} / {report.validation_loss:.4f}  "
                        f"IoU {100 * report.iou:.1f} %"
                    )
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
                    answer |= report.model_dump(mode="json", exclude={"kind"})
                case TrainingCancelled():
                    screen.say(f"Cancelled after epoch {report.done}; continue with --resume.")
                    answer |= {"cancelled": True, "done": report.done}

        run_id = run_training(job, show, screen.say, progress_lines())
    if run_id is not None:
        answer["run"] = run_id
    screen.result({**answer, "curve": curve})
    return 1 if "cancelled" in answer else 0
