"""Text of the train workspace."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from touchdown.app.shell import duration_text, error_card, probe_count
from touchdown.app.train.reading import ModelInUse
from touchdown.backend.core import FaultError, InputError
from touchdown.backend.episodes import group_noun
from touchdown.backend.learning import (
    HARDWARE_PROBES,
    SHIPPED_MODEL,
    Curve,
    ModelCard,
    TrainingRun,
    TrainingSetOverview,
)
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.forms import MODALITIES
from touchdown.widgets.lists import TrainingRow
from touchdown.widgets.plots import RUN_COLOURS, CurveLine
from touchdown.widgets.shell import CardText

LETTERS = ("A", "B", "C")
THIN_TEST = 100  # fewer held-out probes say little about a model
WORSE, FEW = "It is worse.", "It was tested on few probes."
# A held-out loss falls further if its second half fell this share of the first: the rate decays.
FALLS_FURTHER = 0.5
OVERFIT = 0.1  # gap between held-out and training loss, as a share of the held-out one
ABOVE = "Not below the model in use: {}. Choose one of them alone to promote it."
ABOVE_ALONE = "Not below the model in use: Promote puts it in use."
FALLING = "Below the model in use. Next: train {} epochs, as the held-out loss of {} still falls."
BY_HEART = (
    "Below the model in use. Next: collect more mountings, as {} fits its {} of {} (loss {:.2f}) "
    "better than held-out ones ({:.2f}). In use: {} of {}."
)
SETTINGS_IN_USE = (
    "Below the model in use. Next: train like it, with '{}' and {} layers of {} units."
)
FEWER = "Below the model in use. Next: collect more mountings, as {} has {} of {}, that {} of {}."
SAME = "Below the model in use. Next: keep that, as {} has as many probes and as large a network."
TRAIN, COLLECT = "Train as advised", "Go to Collect"
NOTHING = "\N{EN DASH}"
SETTINGS = {
    "labels": "labels", "modality": "sees", "layers": "layers", "hidden": "units",
    "optimiser": "optimiser", "learning_rate": "rate", "schedule": "schedule", "epochs": "epochs",
    "patience": "patience", "keep": "keeps", "batch": "batch", "validation_share": "held out",
    "divide_series": "divides series", "seed": "seed", "piece": "piece",
}  # fmt: skip

STILL = CardText(
    "TRAINING-STILL",
    "The training process has stalled: it was suspended, or is blocked.",
    "Nothing is lost; whole epochs are kept.",
    "Continue the process, or press Cancel to end it; Resume goes on from the last epoch.",
    reset=False,
)


def run_row(run: TrainingRun, in_use: ModelInUse | None, marks: Mapping[str, str]) -> TrainingRow:
    """Return a training run as a table row; ``marks`` are the letters of the chosen ones."""
    used = run.card is not None and in_use is not None and is_in_use(run.card, in_use)
    began = datetime.fromtimestamp(run.about.started_ns / 1e9)
    day = "" if began.date() == datetime.now().date() else f"{began:%d %b} "
    mark = f"{marks[run.uuid]} " if run.uuid in marks else ""
    cells = (
        f"{mark}{day}{began:%H:%M:%S} {run.piece or '?'}",
        tr("in use" if used else run.state),
        _setting(run.about.params.get("modality", "?")),
        _per_cent(run.value("iou", run.best_epoch)),
    )
    return TrainingRow(run.uuid, cells)


def is_in_use(card: ModelCard, in_use: ModelInUse) -> bool:
    """Return True if the model of ``card`` is in use for its piece."""
    return card.piece == in_use.piece and card.weights_sha256 == in_use.weights_sha256


def model_in_use_text(in_use: ModelInUse | None) -> str:
    """Return the model in use and the effect of a roll-back as text."""
    if in_use is None:
        return ""
    iou, held_out = (0.0, 0) if in_use.card is None else _test(in_use.card)
    figure = tr(", IoU {:.0f} %", 100 * iou) if held_out else ""
    said = tr("In use for {}: the shipped model{}.", in_use.piece, figure)
    if in_use.before is not None:
        since = f"{datetime.fromtimestamp(in_use.since_ns / 1e9):%d %b %H:%M}"
        models = f"{_model(in_use.weights_sha256)}{figure}", since, _model(in_use.before)
        said = tr("In use for {}: {}, since {}; before it {}.", in_use.piece, *models)
    return said


def promotion_question(card: ModelCard, used: ModelCard | None) -> str:
    """Return the question before a model is put in use, "" if it is good and well tested."""
    if used is None or not (shortfall := _shortfall(card, used)):
        return ""
    (iou, held_out), (used_iou, used_held_out) = _test(card), _test(used)
    figures = "Its IoU is {:.0f} % on {} held out; the model in use has {:.0f} % on {}."
    said = (
        tr("Put this model in use for {}?", card.piece),
        tr(shortfall),
        tr(figures, 100 * iou, count_noun(held_out, "probe"), 100 * used_iou,
           count_noun(used_held_out, "probe")),
    )  # fmt: skip
    return " ".join(said)


class NextStep(NamedTuple):
    """Advice on trainings; ``changes``: settings in which the next one differs from ``run``."""

    text: str
    button: str = ""
    run: TrainingRun | None = None
    changes: Mapping[str, Any] = {}


def next_step(runs: Sequence[TrainingRun], in_use: ModelInUse | None) -> NextStep | None:
    """Return what limits the best of ``runs``, if all are below the model in use, else the others.

    None if there is nothing to compare.
    """
    used = None if in_use is None else in_use.card
    if in_use is None or used is None or not _test(used)[1]:
        return None
    marks = LETTERS if len(runs) > 1 else (tr("this training"),)
    cards = [(mark, run, run.card) for mark, run in zip(marks, runs, strict=False)
             if run.card and run.card.piece == in_use.piece and not is_in_use(run.card, in_use)
             ]  # fmt: skip
    above = [mark for mark, _, card in cards if _shortfall(card, used) != WORSE]
    if above or not cards:
        text = tr(ABOVE, ", ".join(above)) if len(runs) > 1 else tr(ABOVE_ALONE)
        return NextStep(text) if above else None
    mark, run, card = max(cards, key=lambda one: _test(one[2])[0])
    train, held_out = ([loss for _, loss in run.curves.get(f"{side}_loss", ())]
                       for side in ("train", "validation"))  # fmt: skip
    if _still_falls(held_out):
        epochs = 2 * len(held_out)
        return NextStep(tr(FALLING, epochs, mark), TRAIN, run, {"epochs": epochs})
    data, data_in_use = _amount(card), _amount(used)
    if train and held_out and held_out[-1] - train[-1] > OVERFIT * held_out[-1]:
        text = tr(BY_HEART, mark, *data, train[-1], held_out[-1], *data_in_use)
        return NextStep(text, COLLECT)
    like = {"modality": used.modality, "layers": used.hyper.layers, "hidden": used.hyper.hidden}
    size = used.hyper.layers * used.hyper.hidden
    if not any(one.modality == used.modality and one.hyper.layers * one.hyper.hidden >= size
               for *_, one in cards):  # fmt: skip
        sizes = used.hyper.layers, used.hyper.hidden
        text = tr(SETTINGS_IN_USE, _setting(used.modality), *sizes)
        return NextStep(text, TRAIN, run, like)
    if probe_count(card) < probe_count(used):
        return NextStep(tr(FEWER, mark, *data, *data_in_use), COLLECT)
    return NextStep(tr(SAME, mark))


def _still_falls(losses: Sequence[float]) -> bool:
    """Return True if a loss is least at its end and has hardly slowed down."""
    if len(losses) < 3 or losses[-1] > min(losses):
        return False
    middle = losses[(len(losses) - 1) // 2]
    return middle - losses[-1] > FALLS_FURTHER * max(losses[0] - middle, 0.0)


def _amount(card: ModelCard) -> tuple[str, str]:
    mountings = int(card.data.get("mountings") or 0)
    return count_noun(probe_count(card), "probe"), count_noun(mountings, "mounting")


def _shortfall(card: ModelCard, used: ModelCard) -> str:
    """Return why a model may be worse than the one in use, "" if it is good and well tested."""
    (iou, held_out), (used_iou, used_held_out) = _test(card), _test(used)
    return WORSE if iou < used_iou else FEW if held_out < min(THIN_TEST, used_held_out) else ""


def ended_text(card: ModelCard) -> str:
    """Return what a training gave."""
    iou, held_out = _test(card)
    probes = count_noun(held_out, "held-out probe")
    return tr("The training of {} gave IoU {:.0f} % on {}.", card.piece, 100 * iou, probes)


def _test(card: ModelCard) -> tuple[float, int]:
    """Return the IoU on the probes that were held out, and their number."""
    iou = card.metrics.get("validation", {}).get("iou")
    return (0.0 if iou is None else float(iou)), int(card.data.get("held_out") or 0)


def autonomy_text(probes: int | None) -> str:
    """Return if a simulation model may decide on hardware without approval, as text."""
    if probes is None:
        return ""
    if probes >= HARDWARE_PROBES:
        return tr("Tested on {}: auto mode on hardware.", count_noun(probes, "hardware probe"))
    asks = "Tested on {} ({} needed): approve or step mode only on hardware."
    return tr(asks, count_noun(probes, "hardware probe"), HARDWARE_PROBES)


def split_text(overview: TrainingSetOverview) -> str:
    """Return leaks of the split."""
    kept = tr("{} are held out.", tr(group_noun(overview.kept_together)).capitalize())
    return "\n".join((*overview.warnings, kept))


def split_rows(overview: TrainingSetOverview) -> list[tuple[str, str, str]]:
    """Return the counts per bottom and in total."""
    rows = [(p.bottom, f"{p.train:,}", f"{p.held_out:,}") for p in overview.pairs]
    if len(rows) > 1:
        rows.append((tr("all"), f"{overview.train:,}", f"{overview.held_out:,}"))
    return rows


def curve_lines(runs: Sequence[TrainingRun], name: str) -> list[CurveLine]:
    """Return a metric of the chosen runs, shares in %; for a single one, both losses."""
    if len(runs) == 1 and name == "validation_loss":
        train, valid = (_points(runs[0].curves.get(key, ())) for key in ("train_loss", name))
        return [CurveLine(tr("train"), train, RUN_COLOURS[1], dashed=True),
                CurveLine(tr("valid."), valid, RUN_COLOURS[0])]  # fmt: skip
    marks = LETTERS if len(runs) > 1 else ("",)
    scale = 1.0 if name == "validation_loss" else 100.0
    return [
        CurveLine(mark, _points(run.curves.get(name, ()), scale), token, dashed=at == 1)
        for at, (run, mark, token) in enumerate(zip(runs, marks, RUN_COLOURS, strict=False))
    ]


def reliability_lines(runs: Sequence[TrainingRun]) -> list[CurveLine]:
    """Return the reliability curve of each run at its best epoch."""
    lines = []
    for at, (run, mark, token) in enumerate(zip(runs, LETTERS, RUN_COLOURS, strict=False)):
        bins = run.reliability.get(run.best_epoch, ())
        error = run.value("calibration_error", run.best_epoch)
        name = tr("error {:.3f}", error) if math.isfinite(error) else ""
        name = f"{mark}  {name}" if len(runs) > 1 else name
        lines.append(
            CurveLine(name, tuple((p, share) for p, share, _ in bins), token, dashed=at == 1)
        )
    return lines


def difference_rows(runs: Sequence[TrainingRun]) -> list[tuple[str, ...]]:
    """Return the settings of a single run, or those that differ between several."""
    rows = []
    for key, name in SETTINGS.items():
        values = [run.about.params.get(key) for run in runs]
        if len(runs) == 1 or any(value != values[0] for value in values):
            rows.append((tr(name), *(_setting(value) for value in values)))
    data = [run.about.manifest[:8] or NOTHING for run in runs]
    if runs and (len(runs) == 1 or len(set(data)) > 1):
        rows.append((tr("data"), *data))
    return rows


def figure_rows(runs: Sequence[TrainingRun]) -> list[tuple[str, ...]]:
    """Return IoU and accuracy on the held-out side, per bottom and in total.

    Runs for different pieces have no bottom in common: each row then names its piece.
    """
    pieces = [run.piece or "?" for run in runs]
    several = len(set(pieces)) > 1
    tables = [
        {f"{piece}, {name}" if several else name: one for name, one in _bottoms(run).items()}
        for piece, run in zip(pieces, runs, strict=True)
    ]
    names = sorted({name for table in tables for name in table}, key=lambda n: (n == "all", n))
    return [(tr(name), *(_pair(table.get(name)) for table in tables)) for name in names]


def remaining_time_text(done: int, total: int, seconds: Sequence[float]) -> str:
    """Return the progress of a training; ``seconds``: durations of its epochs so far."""
    if not seconds:
        return tr("epoch {} of {}", done, total)
    recent = seconds[-5:]
    left_s = (total - done) * sum(recent) / len(recent)
    return tr("epoch {} of {}, about {} left", done, total, duration_text(max(left_s, 1.0)))


def failure_card(error: Exception) -> CardText:
    """Return the card of a training that ended early."""
    if isinstance(error, FaultError):
        fault = error.fault
        step = "Choose the run and press Resume; free memory first if it ran short."
        return CardText(fault.code, fault.what, fault.consequence, step, reset=False)
    if not isinstance(error, InputError):
        what = tr("The training failed: {}.", error)
        return CardText("TRAINING", what, "There is no new model.", "Train again.", reset=False)
    return error_card("TRAINING", error)


def _bottoms(run: TrainingRun) -> dict[str, Mapping[str, Any]]:
    if run.card is None:
        return {}
    validation = run.card.metrics.get("validation", {})
    found: dict[str, Mapping[str, Any]] = dict(validation.get("bottoms", {}))
    return {**found, "all": validation}


def _pair(figures: Mapping[str, Any] | None) -> str:
    if figures is None:
        return NOTHING
    return f"{_per_cent(figures['iou'])} / {_per_cent(figures['point_accuracy'])}"


def _points(curve: Curve, scale: float = 1.0) -> tuple[tuple[float, float], ...]:
    return tuple((float(step), scale * value) for step, value in curve)


def _per_cent(value: float) -> str:
    return f"{100 * value:.1f}" if math.isfinite(value) else NOTHING


def _setting(value: object) -> str:
    if isinstance(value, bool):
        return tr("yes" if value else "no")
    name = f"{value:g}" if isinstance(value, float) else str(value)
    return tr(dict(MODALITIES).get(name, name))


def _model(sha256: str) -> str:
    return tr("the one that ships") if sha256 == SHIPPED_MODEL else tr("model {}", sha256[:8])
