"""``touchdown evaluate``: measure a contact-patch model on labelled episodes."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from touchdown.backend.cli.output import VerbOutput, text_table
from touchdown.backend.config import StabilitySettings
from touchdown.backend.runs import models_folder

if TYPE_CHECKING:
    from touchdown.backend.learning import EvaluationScores


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("model", type=Path, help="model file (.safetensors)")
    add("data", type=Path, help="a dataset, or the folder that 'touchdown simulate --out' wrote")
    add("--labels", choices=("approved", "submitted", "drafts"), default="approved",
        help="which labels of a dataset count")  # fmt: skip
    add("--delta", type=float, default=StabilitySettings().delta,
        help="a point supports above this probability")  # fmt: skip
    add("--pieces", type=Path, metavar="DIR", help="folder with further piece files")
    add("--calibrate", action="store_true", help="fit temperature, bias and prior of the strategy "
        "paper-calibrated to these episodes and store them with the model; the mountings should "
        "not be those of the training")  # fmt: skip


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Evaluate and print the scores per bottom; return 0."""
    # Imported here so that `touchdown --help` starts without torch.
    from touchdown.backend.learning import (
        ModelRegistry,
        calibrate_model,
        evaluate,
        hardware_rows,
        load_checkpoint,
        load_episodes,
        pretraining_text,
        save_card,
    )

    checkpoint = load_checkpoint(args.model)
    card = checkpoint.card
    rows = load_episodes(args.data, card.piece, args.labels)
    scores = evaluate(checkpoint, rows, delta=args.delta, pieces=args.pieces)
    real = hardware_rows(rows)
    if real is not None:
        of_real = evaluate(checkpoint, real, delta=args.delta, pieces=args.pieces)["all"]
        registry = ModelRegistry(models_folder())
        registry.note_hardware(card.weights_sha256, len(real), of_real.iou, of_real.point_accuracy)
    origin, trained_on = card.data, set[str]()
    while origin:
        trained_on |= set(origin.get("episodes", {}))
        origin = origin.get("pretrained", {}).get("data")
    kind = "simulated" if real is None else f"{len(real)} hardware probes"
    screen.show(score_table(f"{card.piece}, {card.modality} ({kind})", scores, trained_on))
    if text := pretraining_text(card):
        screen.say(text)
    fitted = card.calibration
    if args.calibrate:
        calibrated = calibrate_model(checkpoint, rows)
        save_card(args.model, calibrated)
        fitted = calibrated.calibration
        assert fitted is not None
        screen.say(
            f"Calibration: temperature {fitted.temperature:.2f}, bias {fitted.bias:+.2f}, prior "
            f"{fitted.prior:.3f}, of {fitted.probes} probes; expected calibration error "
            f"{fitted.error_before:.3f} before, {fitted.error_after:.3f} after. Stored with "
            f"{args.model}"
        )
    screen.result({
        "model": str(args.model),
        "calibration": fitted and fitted.model_dump(),
        "piece": card.piece,
        "modality": card.modality,
        "delta": args.delta,
        "simulated": card.simulated,
        "hardware_probes": 0 if real is None else len(real),
        "trained_on": sorted(trained_on),
        **{name: card.data.get(name) for name in ("pretrained", "mixed")},
        "scores": {name: s.as_json() for name, s in scores.items()},
    })  # fmt: skip
    return 0


def score_table(title: str, scores: dict[str, EvaluationScores], trained_on: set[str]) -> Table:
    """Return the table of scores; bottoms that are not in the training data are marked."""
    rows = []
    for name, s in scores.items():
        unseen = "" if name == "all" or name in trained_on else " (unseen)"
        low, high = s.stability_interval
        stable = f"{100 * s.stability_accuracy:.1f} ({100 * low:.0f}-{100 * high:.0f})"
        shares = [f"{100 * share:.1f}" for share in (s.iou, s.point_accuracy, s.base_rate)]
        unsafe = "-" if math.isnan(s.unsafe) else f"{100 * s.unsafe:.1f}"
        rows.append((name + unseen, str(s.episodes), *shares, unsafe, stable))
    columns = ("episodes", "IoU %", "points right %", "base rate %", "unsafe %", "stable right %")
    table = text_table(title, ("bottom", *columns), *rows, right=columns)
    table.caption = "judged from one probe; 95 % Wilson interval of the stability accuracy"
    return table
