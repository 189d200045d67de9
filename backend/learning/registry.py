"""Model registry: models in use per piece, their history, and clearance for a bench.

The history only grows; models are copied into the registry. A model may decide without confirmation
only if no field of its card contradicts the bench.
"""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchdown.backend.config import BenchDescription
from touchdown.backend.core import InputError, append_line, read_json_lines, write_atomically
from touchdown.backend.learning.checkpoint import ModelCard, load_card, load_checkpoint, save_card

HARDWARE_PROBES = 50  # hardware probes required for a model trained on simulation only


@dataclass(frozen=True, slots=True)
class CardMismatch:
    """Field of a model card that contradicts the bench."""

    field: str
    card: str
    bench: str

    def __str__(self) -> str:
        return f"{self.field}: the model {self.card}, the bench {self.bench}"


def card_mismatches(
    card: ModelCard, bench: BenchDescription, piece: str, grid_mm: float, hardware_probes: int
) -> tuple[CardMismatch, ...]:
    """Return the fields that prevent autonomous use; fields unknown on either side are ignored.

    ``piece`` is the hash of the grasped piece, ``grid_mm`` the pitch of its face points,
    ``hardware_probes`` the number of hardware probes in the evaluation.
    """
    found = []
    if card.geometry != piece:
        found.append(CardMismatch("piece hash", _short(card.geometry), _short(piece)))
    if card.grid_mm != grid_mm:
        found.append(CardMismatch("grid", f"{card.grid_mm:g} mm", f"{grid_mm:g} mm"))
    # An emulated bench rehearses work on hardware, so the same rule holds.
    transfer = card.simulated and bench.mode in ("hardware", "emulated")
    if transfer and hardware_probes < HARDWARE_PROBES:
        evaluated = f"{hardware_probes} of {HARDWARE_PROBES} hardware probes evaluated"
        found.append(CardMismatch("bench mode", "simulated only", f"{bench.mode}, {evaluated}"))
    names = {"mm_per_px": "mm/px", "ft_frame": "F/T frame"}
    if not transfer:
        # A simulated and a real bench never share these fields.
        names = {"mode": "bench mode", "sha256": "bench hash", **names}
    found += [
        m for name, text in names.items() if (m := _compared(card.benches, bench, name, text))
    ]
    return (*found, *gel_mismatches(card, bench))


def gel_mismatches(card: ModelCard, bench: BenchDescription) -> list[CardMismatch]:
    """Return the fingers whose gel is none of those that the training data come from."""
    found = []
    for at, (name, here) in enumerate(
        zip(("left gel", "right gel"), bench.gels or (), strict=False)
    ):
        known = {one.gels[at] for one in card.benches if one.gels} - {""}
        if here and known and here not in known:
            found.append(CardMismatch(name, " or ".join(sorted(known)), here))
    return found


def check_autonomous(card: ModelCard, found: Sequence[CardMismatch], where: str) -> None:
    """Raise ``InputError`` with the fields that do not fit."""
    if found:
        fields = "; ".join(str(one) for one in found)
        what = f"The model of '{card.piece}' must not run in auto mode here: {fields}."
        fix = "Choose approve or step mode, or a model trained for this bench."
        raise InputError(what, where, fix)


def _compared(
    benches: Sequence[BenchDescription], bench: BenchDescription, name: str, text: str
) -> CardMismatch | None:
    """Compare one field with all benches of the training data."""
    known = [value for one in benches if (value := getattr(one, name))]
    here = getattr(bench, name)
    if not known or not here or here in known:
        return None
    return CardMismatch(text, " or ".join(sorted({_short(v) for v in known})), _short(here))


def _short(value: object) -> str:
    if isinstance(value, tuple):
        return " / ".join(f"{v:g}" for v in value)
    text = str(value)
    hexadecimal = len(text) == 64 and all(c in "0123456789abcdef" for c in text)
    return text[:12] if hexadecimal else f"'{text}'"


HISTORY, EVALUATIONS, ENSEMBLES = "in-use.jsonl", "hardware.jsonl", "pre-label.jsonl"
SHIPPED_MODEL = ""  # the shipped model, in use until another one is promoted
_SHA256 = re.compile(r"[0-9a-f]{64}")


class ModelUse(BaseModel):
    """One change of the model in use; ``run`` is the training that made it."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")
    piece: Annotated[str, Field(pattern=r"^[\w-][\w.-]*$")]
    action: Literal["promote", "roll back"]
    weights_sha256: Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")]  # "": the shipped model
    at_ns: int = 0
    person: str = ""
    run: str = ""


class ModelRegistry:
    """Models in use. Files are read on every call, since other processes may change them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.Lock()

    def in_use(self, piece: str) -> Path | None:
        """Return the hash of the weights in use for ``piece``; None for the shipped model."""
        sha256 = self._stack(piece)[-1]
        return None if sha256 == SHIPPED_MODEL else self._weights(piece, sha256)

    def before(self, piece: str) -> str | None:
        """Return the hash that a roll back restores ("": shipped model); None if there is none."""
        stack = self._stack(piece)
        return stack[-2] if len(stack) > 1 else None

    def history(self, piece: str | None = None) -> list[ModelUse]:
        """Return all changes, oldest first; raises ``InputError`` for a damaged line."""
        path = self.folder / HISTORY
        try:
            uses = [ModelUse.model_validate(line) for line in read_json_lines(path)]
        except ValidationError as error:
            raise _damaged(path) from error
        return [use for use in uses if piece is None or use.piece == piece]

    def promote(self, model: Path, person: str = "", run: str = "") -> ModelUse:
        """Check and copy ``model``, and use it for its piece; no change if already in use."""
        card = load_checkpoint(model).card
        with self._lock:
            if self._stack(card.piece)[-1] == card.weights_sha256:
                return self.history(card.piece)[-1]
            copy = self._weights(card.piece, card.weights_sha256)
            write_atomically(copy, model.read_bytes())
            save_card(copy, card)
            return self._append(
                piece=card.piece, action="promote", weights_sha256=card.weights_sha256,
                person=person, run=run,
            )  # fmt: skip

    def roll_back(self, piece: str, person: str = "") -> ModelUse:
        """Restore the previous model; raises ``InputError`` if there is none."""
        with self._lock:
            before = self.before(piece)
            if before is None:
                what = f"The model of '{piece}' was never changed."
                fix = "Promote another model first."
                raise InputError(what, str(self.folder / HISTORY), fix)
            return self._append(
                piece=piece, action="roll back", weights_sha256=before, person=person
            )

    def ensemble(self, piece: str) -> tuple[Path, ...]:
        """Return the models that pre-label ``piece`` together, if any were chosen."""
        chosen: object = ()
        for line in read_json_lines(self.folder / ENSEMBLES):
            if line.get("piece") == piece:
                chosen = line.get("weights_sha256")
        if not isinstance(chosen, list | tuple) or not all(map(_is_sha256, chosen)):
            raise _damaged(self.folder / ENSEMBLES)
        return tuple(self._weights(piece, sha256) for sha256 in chosen)

    def choose_ensemble(self, piece: str, models: Sequence[Path], person: str = "") -> None:
        """Check and copy ``models`` for pre-labelling ``piece``; none: the model in use."""
        cards = [load_checkpoint(model).card for model in models]
        for model, card in zip(models, cards, strict=True):
            if card.piece != piece:
                what = f"The model is of '{card.piece}', not of '{piece}'."
                raise InputError(what, str(model), "Choose models of one piece.")
        with self._lock:
            for model, card in zip(models, cards, strict=True):
                copy = self._weights(piece, card.weights_sha256)
                write_atomically(copy, model.read_bytes())
                save_card(copy, card)
            names = sorted({card.weights_sha256 for card in cards})
            line = {"piece": piece, "weights_sha256": names, "person": person,
                    "at_ns": time.time_ns()}  # fmt: skip
            _append_line(self.folder / ENSEMBLES, line)

    def note_hardware(self, weights_sha256: str, probes: int, iou: float, accuracy: float) -> None:
        """Record an evaluation on ``probes`` of a real bench."""
        line = {"weights_sha256": weights_sha256, "probes": probes, "iou": iou,
                "point_accuracy": accuracy, "at_ns": time.time_ns()}  # fmt: skip
        with self._lock:
            _append_line(self.folder / EVALUATIONS, line)

    def hardware_probes(self, weights_sha256: str, since_ns: int = 0) -> int:
        """Return the largest number of hardware probes in one evaluation from ``since_ns`` on."""
        lines = read_json_lines(self.folder / EVALUATIONS)
        lines = [line for line in lines if line.get("at_ns", 0) >= since_ns]
        counts = [e.get("probes") for e in lines if e.get("weights_sha256") == weights_sha256]
        return max((n for n in counts if isinstance(n, int)), default=0)

    def _weights(self, piece: str, sha256: str) -> Path:
        return self.folder / piece / f"{sha256}.safetensors"

    def _stack(self, piece: str) -> list[str]:
        """Return the models to roll back to, the present one last."""
        stack = [SHIPPED_MODEL]
        for use in self.history(piece):
            if use.action == "promote":
                stack.append(use.weights_sha256)
            elif len(stack) > 1:
                stack.pop()
        return stack

    def _append(self, **change: Any) -> ModelUse:
        use = ModelUse(at_ns=time.time_ns(), **change)
        _append_line(self.folder / HISTORY, use.model_dump())
        return use


def models_below(folder: Path, piece: str) -> list[Path]:
    """Return the models of ``piece`` in and below ``folder``; other files are skipped."""
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*.safetensors")):
        try:
            card = load_card(path)
        except InputError:
            continue
        if card.piece == piece:
            found.setdefault(card.weights_sha256, path)
    return list(found.values())


def _is_sha256(text: object) -> bool:
    return isinstance(text, str) and _SHA256.fullmatch(text) is not None


def _append_line(path: Path, line: Mapping[str, object]) -> None:
    append_line(path, json.dumps(line, sort_keys=True, ensure_ascii=False).encode())


def _damaged(path: Path) -> InputError:
    return InputError(
        "The history of models in use is damaged.",
        str(path),
        "Move the file away: the shipped models are used until another is promoted.",
    )
