"""Text for bench states, connection questions and models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PySide6.QtWidgets import QFrame, QHBoxLayout, QPushButton

from touchdown.app.shell.bench_link import Link
from touchdown.backend.bench import model_in_use, shipped_model
from touchdown.backend.core import InputError
from touchdown.backend.learning import ModelCard, ModelRegistry, load_card
from touchdown.backend.learning.fused import shipped_fused
from touchdown.backend.runs import models_folder
from touchdown.widgets.base import label


@dataclass(frozen=True, slots=True)
class BenchWords:
    """``title`` of the window; ``banner`` in the foot, ``striped`` unless it is hardware."""

    title: str
    banner: str
    tip: str
    striped: bool
    note: str
    """Small second line of the pill; "" with hardware."""


def words_of(link: Link) -> BenchWords:
    """Return what to call the bench of ``link``, by the facts that its recordings carry too."""
    mode = link.facts.mode
    if mode == "simulated":
        return BenchWords(
            "Touchdown (SIMULATED)",
            "SIMULATED BENCH",
            "No hardware is connected. Everything you see is computed.",
            True,
            "simulated",
        )
    if mode == "emulated":
        return BenchWords(
            f"Touchdown (EMULATED: {link.name})",
            "EMULATED BENCH",
            "Real drivers and wires, emulated devices: no hardware moves.",
            True,
            "emulated",
        )
    return BenchWords(
        f"Touchdown ({link.name})",
        link.name,
        "Real devices: the arm of this lab moves.",
        False,
        "",
    )


class QuestionRow(QFrame):
    """The no is the first answer and does nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.setProperty("role", "question")
        self.text = label("", "title", wrap=True)
        self.no, self.yes = QPushButton("No"), QPushButton("Yes")
        self._act: Callable[[], None] | None = None
        row = QHBoxLayout(self)
        row.addWidget(self.text, 1)
        for button in (self.no, self.yes):
            button.setAutoDefault(False)
            row.addWidget(button)
        self.no.clicked.connect(self.withdraw)
        self.yes.clicked.connect(self._accept)
        self.hide()

    def ask(self, text: str, no: str, yes: str, act: Callable[[], None]) -> None:
        """Ask; ``act`` is done on the yes."""
        self._act = act
        self.text.setText(text)
        for button, word in ((self.no, no), (self.yes, yes)):
            button.setText(word)
            button.setAccessibleName(f"{word}: {text}")
        self.show()

    def withdraw(self) -> None:
        """Ask no more."""
        self._act = None
        self.hide()

    def _accept(self) -> None:
        act = self._act
        self.withdraw()
        if act is not None:
            act()


SEES = {"FT+Tac": "touch and wrench", "Tac": "touch", "FT": "the wrench"}


@dataclass(frozen=True, slots=True)
class ModelWords:
    """``short`` fits beside a caption, ``full`` is for the tool tip."""

    short: str
    full: str


UNPROBED = ModelWords("none, nothing is probed", "The piece is let go as it came, untested.")
BY_WRENCH = ModelWords("none, the wrench decides", "No network reads the probes.")
NONE_HERE = ModelWords("none in this scene", "Collecting needs none.")


def model_words(piece: str, strategy: str) -> ModelWords:
    """Say which model a run of ``strategy`` with ``piece`` would take now."""
    if strategy == "pick-and-place":
        return UNPROBED
    if strategy == "zero-wrench":
        return BY_WRENCH
    try:
        return fused_words() if strategy == "fused" else card_words(card_in_use(piece))
    except InputError as error:
        return ModelWords("cannot be read", f"{error.what} {error.fix}")


def scene_words(card: ModelCard | None, piece: str, *, simulated: bool) -> ModelWords:
    """Say which model reads the present scene, and whether another one is in use since."""
    here = NONE_HERE if card is None else card_words(card)
    try:
        used = card_in_use(piece)
    except InputError:
        return here
    if card is not None and used.weights_sha256 == card.weights_sha256:
        return here
    taker = "Set (Ctrl+N), or a stacking run," if simulated else "A stacking run"
    then = f"{taker} takes the one in use: {card_words(used).short}."
    return ModelWords(f"{here.short}; in use: {_whose(used)}", f"{here.full}\n{then}")


def card_in_use(piece: str) -> ModelCard:
    """Return the card of the model in use for ``piece``; raises ``InputError``."""
    return load_card(model_in_use(piece, ModelRegistry(models_folder())))


def card_words(card: ModelCard) -> ModelWords:
    """Say whose model it is, how good it was and on how much it was trained."""
    probes, found = _probes(card), card.metrics.get("validation", {}).get("iou")
    iou = "" if found is None else f"IoU {100 * found:.0f} %"
    trained = f"{probes:,} {'probe' if probes == 1 else 'probes'}" if probes else ""
    short = (_whose(card), iou, "" if _ships(card) else trained)
    kind = "simulated" if card.simulated else "of devices"
    whence = "the one that ships" if _ships(card) else "promoted in Train"
    lines = (
        f"Model {card.weights_sha256[:12]} for {card.piece}, {whence}.",
        f"It sees {SEES[card.modality]}.",
        f"Trained on {trained} ({kind})." if trained else "",
        f"{iou} on the probes that were held out." if iou else "",
    )
    return ModelWords(", ".join(filter(None, short)), "\n".join(filter(None, lines)))


def fused_words() -> ModelWords:
    """Say which network fuses; raises ``InputError``."""
    card = shipped_fused().card
    sequences = card.training.get("sequences")
    lines = (
        f"The fusing network that ships: {card.weights_sha256[:12]}.",
        f"Trained on {sequences:,} simulated sequences of probes." if sequences else "",
        "It reads the signals of all probes itself: a promoted model changes nothing in it.",
    )
    return ModelWords("its own, shipped", "\n".join(filter(None, lines)))


def _whose(card: ModelCard) -> str:
    return "shipped" if _ships(card) else f"yours {card.weights_sha256[:8]}"


def _ships(card: ModelCard) -> bool:
    try:
        return load_card(shipped_model(card.piece)).weights_sha256 == card.weights_sha256
    except InputError:
        return False


def _probes(card: ModelCard) -> int:
    """Return on how many probes it was made, both sides together; 0 where the card tells none."""
    counts = card.data.get("episodes")
    values = counts.values() if isinstance(counts, dict) else (counts,)
    return sum(count for count in values if isinstance(count, int))
