"""Bring foreign episodes in: new episodes of the mode ``imported``, a series of their own, drafts.

An export of Touchdown names its episodes in the manifest: their labels, grips and geometry come
back as they were. Everything is read and looked at before anything is written; an import that was
interrupted goes on where it was, because an episode is named by its content.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np

from backend.catalogue import operations
from backend.catalogue.dataset import Dataset
from backend.catalogue.review import check_person
from backend.catalogue.split_tags import SPLIT_TAG
from backend.catalogue.uuid7 import from_parts, is_uuid7, uuid7
from backend.catalogue.values import EpisodeContext, Label
from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.core.flow import Episode, EpisodeQuality
from backend.exchange import mapping
from backend.exchange.exporting import PARTIAL
from backend.exchange.features import COMMANDED
from backend.exchange.foreign import read_foreign
from backend.exchange.foreign_episode import ForeignEpisode
from backend.exchange.manifest import GEOMETRY, Manifest, read_manifest
from backend.exchange.mapping import Mapped
from backend.exchange.noting import note_import
from backend.objects.catalogue import load_catalogue

MODE = "imported"
OWN_BITS, NUMBER_AT = 24, 48
TRUSTED = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)
"""The checks need signals that a foreign file does not have."""


@dataclass(frozen=True, slots=True)
class ImportWish:
    """What is not in a foreign file: the pair, and who labelled it (None: nobody we know)."""

    actor: str
    labelled_by: str | None = None
    piece: str | None = None
    bottom: str | None = None


@dataclass(frozen=True, slots=True)
class Survey:
    """What an import would do: how many episodes map, how many are here already, and what not."""

    found: int
    fit: int
    here: int
    problems: tuple[tuple[str, int], ...]
    losses: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Origin:
    """Where one episode belongs: pair, grip and mounting, label and side."""

    uuid: str
    piece: str
    bottom: str
    geometry: str
    grip_id: str
    mounting_id: str
    label: Label
    source: str
    side: str


class Import:
    """One import of episodes: ``survey`` first, then ``write``. Raises ``InputError`` at once for
    a manifest that does not fit its files, or a pair that is not named.
    """

    def __init__(self, dataset: Dataset, kind: str, source: Path, wish: ImportWish) -> None:
        if source.name.endswith(PARTIAL):
            raise InputError("This export was interrupted.", str(source), "Export it again.")
        self._dataset, self._kind, self._source, self._wish = dataset, kind, source, wish
        self._actor = check_person(wish.actor)
        self._manifest = read_manifest(source) if source.is_dir() else None
        self._named = _by_number(self._manifest, kind, source)
        spec = (self._manifest or {}).get("feature_spec")
        self.backup: Path | None = None
        """The catalogue as it was before ``write``; None until then, or of an empty dataset."""
        self._commanded = isinstance(spec, Mapping) and spec.get("action") == COMMANDED
        known = dataset.database.rows("SELECT uuid FROM episode")
        self._known = {uuid for (uuid,) in known}
        self._geometry = "" if self._named else self._own_pair()
        self.total = len(self._named) or None

    def survey(self, advance: Callable[[int], None] = lambda done: None) -> Survey:
        """Read everything and tell what could not be mapped; nothing is written."""
        problems: Counter[str] = Counter()
        lost: dict[str, None] = {}
        found = fit = here = 0
        for foreign in read_foreign(self._kind, self._source):
            found += 1
            reason = self._reason(foreign)
            if reason:
                problems[reason] += 1
            elif self._is_here(foreign):
                here += 1
            else:
                fit += 1
                lost |= dict.fromkeys(mapping.losses(foreign))
            advance(found)
        return Survey(found, fit, here, tuple(sorted(problems.items())), tuple(lost))

    def write(self, advance: Callable[[int], None] = lambda done: None) -> list[str]:
        """Write the episodes that map and are not here yet; returns their ids.

        Raises ``FaultError`` before anything is written if the catalogue cannot be backed up.
        """
        self.backup = self._dataset.back_up_for("import")
        self._take_geometry()
        series, written = uuid7(), list[tuple[str, str]]()
        for foreign in read_foreign(self._kind, self._source):
            if self._reason(foreign) or self._is_here(foreign):
                continue
            mapped = mapping.mapped(foreign, commanded=self._commanded)
            written.append(self._record(mapped, series))
            advance(len(written))
        self._note(series, written)
        return [uuid for uuid, _ in written]

    def _reason(self, foreign: ForeignEpisode) -> str:
        if self._named and foreign.index not in self._named:
            return "the manifest does not name it"
        return mapping.problem(foreign)

    def _is_here(self, foreign: ForeignEpisode) -> bool:
        named = self._named.get(foreign.index)
        own = str(named["uuid"]) if named else foreign.uuid
        return own in self._known or self._uuid(mapping.mapped(foreign)) in self._known

    def _uuid(self, mapped: Mapped) -> str:
        """Return the id of an imported episode: the same whenever it is imported.

        It sorts as the id it had, else by its number, so that a later export has the same order.
        """
        number = mapped.foreign.index
        named = self._named.get(number)
        digest = sha256(mapped.observation.tobytes())
        digest.update(str(named["uuid"] if named else number).encode("utf-8"))
        own = int.from_bytes(digest.digest()[:4], "big") >> (32 - OWN_BITS)
        if named is None:
            return from_parts(0, number << NUMBER_AT | int.from_bytes(digest.digest()[:6], "big"))
        former = UUID(named["uuid"]).int
        return str(UUID(int=former >> OWN_BITS << OWN_BITS | own))

    def _record(self, mapped: Mapped, series: str) -> tuple[str, str]:
        origin = self._origin(mapped, series)
        context = EpisodeContext(
            series=series, bottom=origin.bottom, geometry=origin.geometry, person=self._actor,
            grip_id=origin.grip_id, mounting_id=origin.mounting_id, mode=MODE,
            bench={"imported_from": self._kind},
        )  # fmt: skip
        uuid = self._uuid(mapped)
        offset = origin.label.offset_mm if origin.label.is_set else np.zeros(2)
        pairs = (("imported_as", origin.uuid),) if origin.uuid else ()
        episode = Episode(uuid, origin.piece, mapped.observation, offset, 0.0, TRUSTED,
                          mapped.recording, pairs)  # fmt: skip
        has_frames = mapped.recording is not None and bool(mapped.recording.frames)
        self._dataset.record(
            episode, origin.label, source=origin.source, context=context,
            keep_frames="jpeg95_444" if has_frames else "none",
        )  # fmt: skip
        return uuid, origin.side

    def _origin(self, mapped: Mapped, series: str) -> _Origin:
        foreign, named = mapped.foreign, self._named.get(mapped.foreign.index)
        if named is not None:
            return _Origin(
                named["uuid"], named["piece"], named["bottom"], named["geometry"],
                named["grip_id"], named["mounting_id"], Label(**named["label"]), named["source"],
                named["split"],
            )  # fmt: skip
        # Nothing says which episodes shared a grip: one for all, so that no split can leak.
        source = "human" if self._wish.labelled_by else "measured"
        piece, bottom = str(self._wish.piece), str(self._wish.bottom)
        return _Origin(foreign.uuid, piece, bottom, self._geometry, f"{series}/unknown",
                       f"{series}/unknown", mapped.label, source, foreign.side)  # fmt: skip

    def _own_pair(self) -> str:
        if self._wish.piece is None or self._wish.bottom is None:
            raise InputError(
                "The file does not say which pieces touched.",
                str(self._source),
                "Name them with --piece and --bottom.",
            )
        pieces = load_catalogue()
        top, bottom = pieces.piece(self._wish.piece), pieces.piece(self._wish.bottom)
        return self._dataset.geometry.store_pair(top, bottom)

    def _take_geometry(self) -> None:
        """Bring the geometry records along; each is checked against its name when it is used."""
        for name in self._manifest["geometry"] if self._manifest else ():
            path = self._dataset.geometry.folder / f"{name}.json"
            if not path.exists():
                write_atomically(path, (self._source / GEOMETRY / f"{name}.json").read_bytes())
        for named in self._named.values():
            self._dataset.geometry.pair(named["geometry"])

    def _note(self, series: str, written: Sequence[tuple[str, str]]) -> None:
        """Keep the sides of the split as tags, in one operation, and the import in the audit."""
        with self._dataset.database.reading() as connection:
            marks = [
                operations.mark_of(connection, uuid, f"{SPLIT_TAG}{side}", present=True)
                for uuid, side in written
                if side
            ]
        body: dict[str, str | int] = {"format": self._kind, "episodes": len(written)}
        note_import(self._dataset, self._actor, operations.Draft(marks=marks), series, body)
        self._dataset.labels.take_stock()


def _by_number(manifest: Manifest | None, kind: str, source: Path) -> dict[int, Mapping[str, Any]]:
    if manifest is None:
        return {}
    try:
        if manifest["format"] != kind:
            raise ValueError(f"it is an export to {manifest['format']}, not {kind}")
        named = {int(e["export_index"]): e for e in manifest["episodes"]}
        for episode in named.values():
            label = Label(**episode["label"])
            _check(episode, label)
        names = [str(name) for name in manifest["geometry"]]
        if not all(len(name) == 64 and name.isalnum() for name in names):
            raise ValueError("a geometry record has a bad name")
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"The manifest cannot be used: {error}.", str(source), "Export it again."
        ) from error
    return named


def _check(episode: Mapping[str, Any], label: Label) -> None:
    texts = ("uuid", "piece", "bottom", "geometry", "grip_id", "mounting_id", "source", "split")
    if any(not isinstance(episode[name], str) for name in texts):
        raise ValueError("an episode lacks a name")
    if not is_uuid7(episode["uuid"]):
        raise ValueError("an episode has an id of another kind")
    values = (label.x_um, label.y_um, label.theta_mdeg, label.sigma_um)
    if any(value is not None and type(value) is not int for value in values):
        raise ValueError("a label is not in whole µm and mdeg")
