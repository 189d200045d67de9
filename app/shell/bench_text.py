"""Text for benches and models."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

from touchdown.backend.bench import Session, model_in_use
from touchdown.backend.core import InputError
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.learning import ModelCard, ModelRegistry, load_card, pretraining_text
from touchdown.backend.learning.fused import load_network
from touchdown.backend.placement import shipped_model
from touchdown.backend.runs import LEARNED, models_folder
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.forms import MODALITIES


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
    if mode == "simulated":
        tip = "No hardware is connected. Everything you see is computed."
        title, note = tr("SIMULATED"), tr("simulated")
        return BenchCaption(f"Touchdown ({title})", "SIMULATED BENCH", tip, True, note)
    tip = "Real drivers and wires, emulated devices: no hardware moves."
    title, note = f"{tr('EMULATED')}: {bench.name}", tr("emulated")
    return BenchCaption(f"Touchdown ({title})", "EMULATED BENCH", tip, True, note)


def piece_titles(catalogue: PieceLibrary) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return (name, title) of the pieces and of the bottoms, for lists to choose from."""
    tops, bottoms = (
        [(name, catalogue.piece(name).title) for name in names]
        for names in (catalogue.tops, catalogue.bottoms)
    )
    return tops, bottoms


def tower_text(*names: str) -> str:
    """Return pieces from the top down: "pot on short on long"."""
    return reduce(lambda above, below: tr("{} on {}", above, below), names)


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
        if strategy in LEARNED:
            return fused_caption(LEARNED[strategy].get("fused", {}).get("weights", ""))
        return card_caption(model_card_in_use(piece))
    except InputError as error:
        return ModelCaption(tr("cannot be read"), f"{error.what} {error.fix}")


def scene_model_caption(card: ModelCard | None, piece: str, *, simulated: bool) -> ModelCaption:
    """Return the model of the present scene, and if another one was put in use since."""
    here = NONE_HERE if card is None else card_caption(card)
    try:
        used = model_card_in_use(piece)
    except InputError:
        return here
    if card is not None and used.weights_sha256 == card.weights_sha256:
        return here
    taken = "Set (Ctrl+N), or a stacking run, takes the one in use: {}."
    then = tr(taken if simulated else "A stacking run takes the one in use: {}.",
              card_caption(used).short)  # fmt: skip
    origin, short = _model_origin(used), tr("{}, loaded by the next run", _model_origin(used))
    if card is not None:
        short = tr("{}; next run: {}", here.short, origin)
    return ModelCaption(short, f"{tr(here.full)}\n{then}")


def model_card_in_use(piece: str) -> ModelCard:
    """Return the card of the model in use for ``piece``. Raises ``InputError``."""
    return load_card(model_in_use(piece, ModelRegistry(models_folder())))


def card_caption(card: ModelCard) -> ModelCaption:
    """Return origin, accuracy and training data of a model."""
    probes, found = probe_count(card), card.metrics.get("validation", {}).get("iou")
    iou = "" if found is None else f"IoU {100 * found:.0f} %"
    trained = count_noun(probes, "probe") if probes else ""
    short = (_model_origin(card), iou, "" if _is_shipped(card) else trained)
    kind = tr("simulated") if card.simulated else tr("of devices")
    whence = tr("the one that ships") if _is_shipped(card) else tr("promoted in Train")
    lines = (
        tr("Model {} for {}, {}.", card.weights_sha256[:12], card.piece, whence),
        tr("Sees: {}.", tr(dict(MODALITIES)[card.modality])),
        tr("Trained on {} ({}).", trained, kind) if trained else "",
        pretraining_text(card),
        tr("{} on the probes that were held out.", iou) if iou else "",
    )
    return ModelCaption(", ".join(filter(None, short)), "\n".join(filter(None, lines)))


def fused_caption(weights: str) -> ModelCaption:
    """Return a fusion network that ships, by its name. Raises ``InputError``."""
    card = load_network(weights).card
    sequences = card.training.get("sequences")
    lines = (
        tr("The fusing network that ships: {}.", card.weights_sha256[:12]),
        tr("Trained on {:,} simulated sequences of probes.", sequences) if sequences else "",
        tr("It reads the signals of all probes itself: a promoted model changes nothing in it."),
    )
    return ModelCaption(tr("its own, shipped"), "\n".join(filter(None, lines)))


def duration_text(seconds: float) -> str:
    """Return a duration with at most two figures: "40 s", "12 min", "3 h 20 min", "8 days"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return tr("{} days", min(minutes // 1440, 999))


def _model_origin(card: ModelCard) -> str:
    return tr("shipped") if _is_shipped(card) else tr("yours {}", card.weights_sha256[:8])


def _is_shipped(card: ModelCard) -> bool:
    try:
        return load_card(shipped_model(card.piece)).weights_sha256 == card.weights_sha256
    except InputError:
        return False


def probe_count(card: ModelCard) -> int:
    """Return the number of training probes of both sides; 0 if unknown."""
    counts = card.data.get("episodes")
    values = counts.values() if isinstance(counts, dict) else (counts,)
    return sum(count for count in values if isinstance(count, int))
