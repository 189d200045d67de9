"""Text for benches and models."""

from __future__ import annotations

from dataclasses import dataclass

from touchdown.backend.bench import Session, model_in_use, shipped_model
from touchdown.backend.core import InputError
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.learning import ModelCard, ModelRegistry, load_card, pretraining_text
from touchdown.backend.learning.fused import shipped_fused
from touchdown.backend.runs import models_folder


@dataclass(frozen=True, slots=True)
class BenchCaption:
    """Names of the bench: window ``title``, footer ``banner`` (``striped`` unless hardware)."""

    title: str
    banner: str
    tip: str
    striped: bool
    note: str  # second line of the pill; "" with hardware


def bench_caption(bench: Session) -> BenchCaption:
    """Return the names of a bench, consistent with its recordings."""
    mode = bench.description.mode
    if mode not in ("simulated", "emulated"):
        tip = "Real devices: the arm of this lab moves."
        return BenchCaption(f"Touchdown ({bench.name})", bench.name, tip, False, "")
    name, tip = "SIMULATED", "No hardware is connected. Everything you see is computed."
    if mode == "emulated":
        name, tip = "EMULATED", "Real drivers and wires, emulated devices: no hardware moves."
    title = name if mode == "simulated" else f"{name}: {bench.name}"
    return BenchCaption(f"Touchdown ({title})", f"{name} BENCH", tip, True, name.lower())


def piece_titles(catalogue: PieceLibrary) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return (name, title) of the pieces and of the bottoms, for lists to choose from."""
    tops, bottoms = (
        [(name, catalogue.piece(name).title) for name in names]
        for names in (catalogue.tops, catalogue.bottoms)
    )
    return tops, bottoms


MODALITY_NAMES = {"FT+Tac": "touch and wrench", "Tac": "touch", "FT": "the wrench"}


@dataclass(frozen=True, slots=True)
class ModelCaption:
    """``short`` is shown beside a caption, ``full`` in the tool tip."""

    short: str
    full: str


UNPROBED = ModelCaption("none, nothing is probed", "The piece is released without a test.")
WRENCH_ONLY = ModelCaption("none, the wrench decides", "No network reads the probes.")
NONE_HERE = ModelCaption("none loaded", "Collecting needs none.")


def run_model_caption(piece: str, strategy: str) -> ModelCaption:
    """Return the model that a run of ``strategy`` with ``piece`` would use."""
    if strategy == "pick-and-place":
        return UNPROBED
    if strategy == "zero-wrench":
        return WRENCH_ONLY
    try:
        return fused_caption() if strategy == "fused" else card_caption(model_card_in_use(piece))
    except InputError as error:
        return ModelCaption("cannot be read", f"{error.what} {error.fix}")


def scene_model_caption(card: ModelCard | None, piece: str, *, simulated: bool) -> ModelCaption:
    """Return the model of the present scene, and if another one was put in use since."""
    here = NONE_HERE if card is None else card_caption(card)
    try:
        used = model_card_in_use(piece)
    except InputError:
        return here
    if card is not None and used.weights_sha256 == card.weights_sha256:
        return here
    taker = "Set (Ctrl+N), or a stacking run," if simulated else "A stacking run"
    then = f"{taker} takes the one in use: {card_caption(used).short}."
    return ModelCaption(f"{here.short}; next run: {_model_origin(used)}", f"{here.full}\n{then}")


def model_card_in_use(piece: str) -> ModelCard:
    """Return the card of the model in use for ``piece``. Raises ``InputError``."""
    return load_card(model_in_use(piece, ModelRegistry(models_folder())))


def card_caption(card: ModelCard) -> ModelCaption:
    """Return origin, accuracy and training data of a model."""
    probes, found = _probe_count(card), card.metrics.get("validation", {}).get("iou")
    iou = "" if found is None else f"IoU {100 * found:.0f} %"
    trained = count_noun(probes, "probe") if probes else ""
    short = (_model_origin(card), iou, "" if _is_shipped(card) else trained)
    kind = "simulated" if card.simulated else "of devices"
    whence = "the one that ships" if _is_shipped(card) else "promoted in Train"
    lines = (
        f"Model {card.weights_sha256[:12]} for {card.piece}, {whence}.",
        f"It sees {MODALITY_NAMES[card.modality]}.",
        f"Trained on {trained} ({kind})." if trained else "",
        pretraining_text(card),
        f"{iou} on the probes that were held out." if iou else "",
    )
    return ModelCaption(", ".join(filter(None, short)), "\n".join(filter(None, lines)))


def fused_caption() -> ModelCaption:
    """Return the fusion network. Raises ``InputError``."""
    card = shipped_fused().card
    sequences = card.training.get("sequences")
    lines = (
        f"The fusing network that ships: {card.weights_sha256[:12]}.",
        f"Trained on {sequences:,} simulated sequences of probes." if sequences else "",
        "It reads the signals of all probes itself: a promoted model changes nothing in it.",
    )
    return ModelCaption("its own, shipped", "\n".join(filter(None, lines)))


def count_noun(count: int, noun: str) -> str:
    """Return a number with its noun: "1 probe", "1,200 probes"."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def duration_text(seconds: float) -> str:
    """Return a duration with at most two figures: "40 s", "12 min", "3 h 20 min", "8 days"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{min(minutes // 1440, 999)} days"


def _model_origin(card: ModelCard) -> str:
    return "shipped" if _is_shipped(card) else f"yours {card.weights_sha256[:8]}"


def _is_shipped(card: ModelCard) -> bool:
    try:
        return load_card(shipped_model(card.piece)).weights_sha256 == card.weights_sha256
    except InputError:
        return False


def _probe_count(card: ModelCard) -> int:
    """Return the number of training probes of both sides; 0 if unknown."""
    counts = card.data.get("episodes")
    values = counts.values() if isinstance(counts, dict) else (counts,)
    return sum(count for count in values if isinstance(count, int))
