"""Reading of past trainings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from touchdown.backend import learning
from touchdown.backend.annotations import LABEL_CHOICES
from touchdown.backend.bench import model_in_use
from touchdown.backend.core import InputError
from touchdown.backend.geometry import face_points, load_pieces
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.forms import LABEL_TITLES, TrainingForm
from touchdown.widgets.plots import SampleScene

NO_DATA_HINT = "Collect probes (Ctrl+2), or choose another folder (Ctrl+O)."


@dataclass(frozen=True, slots=True)
class ModelInUse:
    """The model in use for ``piece`` ("" is the shipped one); ``before``: None if never changed.

    ``probes``: number of hardware probes it was evaluated on, None for a model not trained on
    simulations alone. ``card``: None if it cannot be read.
    """

    piece: str
    weights_sha256: str
    before: str | None
    since_ns: int
    probes: int | None = None
    card: learning.ModelCard | None = None


@dataclass(frozen=True, slots=True)
class TrainingLookup:
    """Available training data, training runs, and the model in use.

    ``trouble``: why there are no training data.
    """

    overview: learning.TrainingSetOverview
    runs: tuple[learning.TrainingRun, ...]
    in_use: ModelInUse | None
    trouble: str = ""


class TrainingReader:
    """Reads training data. Caches the last episodes, so that another split reads nothing."""

    def __init__(self, registry: learning.ModelRegistry) -> None:
        self._registry = registry
        self._key: tuple[str, str] | None = None
        self._found: Sequence[learning.TrainingCandidate] = ()

    def look(self, form: TrainingForm, *, refresh: bool) -> TrainingLookup:
        """Read data, training runs and registry."""
        data, trouble = Path(form.data), ""
        try:
            if not data.is_dir():
                raise InputError("There are no data here yet.", str(data), NO_DATA_HINT)
            found = self._candidates(form, refresh=refresh)
            trouble = "" if found else _label_hint(form)
        except InputError as error:
            found, trouble = (), f"{error.what} {error.fix}"
            self._key = None
        seen = learning.training_set_overview(
            found, form.piece, form.held_out / 100, form.seed, divide_series=form.divide_series
        )
        runs = tuple(learning.list_training_runs(data))
        piece = seen.piece or (runs[0].piece if runs else "")
        if not piece and (history := self._registry.history()):
            # Without data the model that was changed last can be rolled back.
            piece = history[-1].piece
        return TrainingLookup(seen, runs, self.in_use(piece), trouble)

    def in_use(self, piece: str) -> ModelInUse | None:
        """Return the model in use for a piece."""
        if not piece:
            return None
        path, history = self._registry.in_use(piece), self._registry.history(piece)
        sha256 = learning.SHIPPED_MODEL if path is None else path.stem
        since_ns = history[-1].at_ns if history else 0
        try:
            card = learning.load_card(model_in_use(piece, self._registry))
        except InputError:
            card = None
        probes = None
        if card is not None and card.simulated:
            probes = self._registry.hardware_probes(card.weights_sha256)
        return ModelInUse(piece, sha256, self._registry.before(piece), since_ns, probes, card)

    def promote(self, run: learning.TrainingRun) -> ModelInUse | None:
        """Put the model of a training in use."""
        use = self._registry.promote(run.model, run=run.uuid)
        return self.in_use(use.piece)

    def roll_back(self, piece: str) -> ModelInUse | None:
        """Put the previous model in use again."""
        self._registry.roll_back(piece)
        return self.in_use(piece)

    def _candidates(
        self, form: TrainingForm, *, refresh: bool
    ) -> Sequence[learning.TrainingCandidate]:
        key = (form.data, form.labels)
        if refresh or key != self._key:
            labels = next(name for name in LABEL_CHOICES if name == form.labels)
            self._found = learning.training_candidates(Path(form.data), labels)
            self._key = key
        return self._found


REVIEW_HINT = "No approved label yet. Accept some in Label (Ctrl+2); another person approves them."


def _label_hint(form: TrainingForm) -> str:
    names = [name for name, _ in LABEL_TITLES]
    for name, text in LABEL_TITLES[names.index(form.labels) + 1 :]:
        labels = next(choice for choice in LABEL_CHOICES if choice == name)
        if count := len(learning.training_candidates(Path(form.data), labels)):
            alone = "{} To train alone, choose Labels '{}': {}."
            return tr(alone, tr(REVIEW_HINT), tr(text), count_noun(count, "episode"))
    return tr(REVIEW_HINT)


def sample_scenes(run: learning.TrainingRun) -> list[SampleScene]:
    """Return the samples of a finished training. Raises ``InputError``."""
    samples = learning.load_samples(run.folder)
    points = face_points(load_pieces().piece(run.piece).face)
    return [
        SampleScene(points, s.probability, s.truth, s.bottom, f"IoU {100 * s.iou:.0f} %")
        for s in samples
        if len(points) == len(s.truth)
    ]
