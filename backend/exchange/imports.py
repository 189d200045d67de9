"""Import of foreign episodes as a new series with draft labels.

Imported episodes have the mode ``imported``. Foreign files are opened in a child process with a
deadline: a bad file may hang or crash it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from threading import Event
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import core
from touchdown.backend.annotations import (
    NO_LABEL,
    SPLIT_TAG,
    Dataset,
    EpisodeContext,
    Label,
    OperationDraft,
    check_person,
    is_uuid7,
    read_mark,
    uuid7,
    uuid7_from_parts,
)
from touchdown.backend.config import SAMPLES_PER_PROBE, read_settings
from touchdown.backend.exchange import features
from touchdown.backend.exchange.exports import PARTIAL
from touchdown.backend.exchange.features import ForeignEpisode, RecordedSignal, load_foreign
from touchdown.backend.exchange.label_import import note_import
from touchdown.backend.exchange.manifest import GEOMETRY, Manifest, read_manifest
from touchdown.backend.exchange.mapped_presses import (
    CONTACT_S,
    Contradiction,
    contradictions,
    cut_press,
    find_presses,
    measure_press,
)
from touchdown.backend.exchange.mapping import ImportMapping, MappingChange
from touchdown.backend.geometry import load_pieces

DEADLINE_S = 60.0  # deadline per episode; the first one includes opening the file
MAPPED_DEADLINE_S = 1800.0  # pictures of a whole recording are tracked
CANCEL_S = 0.1  # a cancellation is seen after this time
NEVER = Event()


def read_foreign(
    kind: str, source: Path, deadline_s: float = DEADLINE_S, mapping: Path | None = None,
    cancelled: Event = NEVER,
) -> Iterator[ForeignEpisode]:  # fmt: skip
    """Yield the episodes that the reader ``kind`` finds in ``source``, one at a time.

    With a ``mapping`` file their values are the signals of ``map_signals``.

    Raises ``InputError`` for a file that is damaged, foreign, or not read within the deadline, and
    if it is ``cancelled``.
    """
    if not source.is_dir():
        core.check_file(source, "Name a file or a folder.")
    command = [sys.executable, "-m", "touchdown.backend.exchange.foreign_child", kind]
    with (
        tempfile.TemporaryDirectory(prefix="touchdown-import-") as folder,
        tempfile.TemporaryFile() as stderr,
        subprocess.Popen(
            [*command, str(source.resolve()), folder, *([str(mapping)] if mapping else [])],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr,
        ) as child,
        ThreadPoolExecutor(1) as listener,
    ):  # fmt: skip
        assert child.stdout is not None
        try:
            while True:
                said = listener.submit(child.stdout.readline)
                until_s = time.monotonic() + deadline_s
                while not wait([said], CANCEL_S).done and time.monotonic() < until_s:
                    if cancelled.is_set():
                        raise core.InputError("Cancelled.", str(source), "Nothing was imported.")
                line = said.result(0.0)
                answer: dict[str, str] = json.loads(line) if line.endswith(b"\n") else {}
                if "error" in answer:
                    where = answer["where"] or str(source)
                    raise core.InputError(answer["error"], where, answer["fix"])
                if "episode" not in answer:
                    break
                path = Path(answer["episode"])
                yield load_foreign(path)
                path.unlink()
        except TimeoutError:
            what = f"The file was not read within {deadline_s:g} s and was given up."
            fix = "It is damaged or far too large; use another copy."
            raise core.InputError(what, str(source), fix) from None
        finally:
            child.kill()
        if "done" not in answer:
            stderr.seek(0)
            printed = stderr.read()[-2000:].decode("utf-8", "replace").splitlines()
            last = f" ({printed[-1]})" if printed else ""
            what = f"The reader crashed on this file{last}."
            raise core.InputError(what, str(source), "It is damaged; use another copy.")


def recording_contents(source: Path, cancelled: Event = NEVER) -> list[RecordedSignal]:
    """Return the topics or features of a recording; raises ``InputError`` like ``read_foreign``."""
    (table,) = read_foreign("contents", source, cancelled=cancelled)
    rows = table.values["contents"].tolist()
    return [RecordedSignal(name, kind, int(numbers), int(messages), float(rate_hz))
            for name, kind, numbers, messages, rate_hz in rows]  # fmt: skip


FRAME_SHAPE = (240, 320, 3)
MAX_OFFSET_MM = 1000.0
MAX_NUMBER = 1 << 24


def mapping_problem(foreign: ForeignEpisode) -> str:
    """Return the reason why the episode cannot be mapped, or ""."""
    values = foreign.values
    if not 0 <= foreign.index < MAX_NUMBER:
        return "its number is out of range"
    if not foreign.quality.accepted:
        return f"it is no whole press: {foreign.quality.reasons[0]}"
    needed = {features.MARKERS: core.TACTILE_CHANNELS, features.FT: core.WRENCH_CHANNELS}
    lacking = sorted(set(needed) - set(values))
    if lacking:
        return f"it lacks {', '.join(lacking)}"
    if foreign.fps != features.FPS:
        return f"it has {foreign.fps:g} ticks per second, not {features.FPS}"
    for key, width in needed.items():
        if values[key].shape != (SAMPLES_PER_PROBE, width):
            return f"{key} has shape {values[key].shape}, not ({SAMPLES_PER_PROBE}, {width})"
        if not np.isfinite(values[key].astype(np.float64)).all():
            return f"{key} holds a value that is not finite"
    return ""


def mapping_losses(foreign: ForeignEpisode) -> tuple[str, ...]:
    """Return the information that the file lacks, and the assumptions made instead."""
    if foreign.recording is not None:
        unknown = "A grip or mounting that is unknown counts as one for the whole import ([grips])."
        whole = () if foreign.grip and foreign.mounting else (unknown,)
        return ("Pictures are tracked and not kept.", *whole)
    lost = ("It has no marker fields at their own rate, no bench clock and no tare.",)
    between = "It has no wrench between the ticks and no poses: nothing is replayed there."
    return lost if _has_signals(foreign.values) else (between, *lost)


def _observation(foreign: ForeignEpisode) -> NDArray[np.float32]:
    """Return (20, 258) of an episode for which ``mapping_problem`` found nothing."""
    parts = [foreign.values[key] for key in (features.MARKERS, features.FT)]
    return np.ascontiguousarray(np.concatenate(parts, axis=1).astype(np.float32))


def _has_signals(values: Mapping[str, NDArray[Any]]) -> bool:
    shapes = {
        features.FT_WINDOW: (SAMPLES_PER_PROBE, features.WINDOW, core.WRENCH_CHANNELS),
        features.STATE: (SAMPLES_PER_PROBE, 7),
    }
    # A state may hold other signals behind the pose.
    return all(k in values and values[k][:, : s[1]].shape == s for k, s in shapes.items())


def _recording(values: Mapping[str, NDArray[Any]], *, commanded: bool) -> core.Recording | None:
    """Return the signals, with times from the contact in integer ns."""
    if not _has_signals(values):
        return None
    step_ns, size = features.TICK_NS // features.WINDOW, features.WINDOW * SAMPLES_PER_PROBE
    fine_ns = step_ns * np.arange(1, size + 1)
    ticks_s = 1e-9 * features.TICK_NS * np.arange(1, SAMPLES_PER_PROBE + 1, dtype=np.float64)
    action = values.get(features.ACTION, np.zeros(0)) if commanded else np.zeros(0)
    command_mm = _position_mm(
        action if action.shape == (SAMPLES_PER_PROBE, 7) else np.zeros((0, 3))
    )
    return core.Recording(
        wrench_t_s=np.asarray(fine_ns * 1e-9, dtype=np.float64),
        wrench=values[features.FT_WINDOW].reshape(-1, core.WRENCH_CHANNELS).astype(np.float64),
        fields=(),
        frames=_frames(values, ticks_s),
        pose_t_s=ticks_s,
        pose_mm=_position_mm(values[features.STATE]),
        tare=np.zeros(core.WRENCH_CHANNELS),
        command_t_s=np.asarray(ticks_s + 1e-9 * features.TICK_NS)[: len(command_mm)],
        command_mm=command_mm,
    )


def _position_mm(poses: NDArray[Any]) -> core.FloatArray:
    return np.asarray(poses[:, :3].astype(np.float64) * 1e3, dtype=np.float64)


def _frames(
    values: Mapping[str, NDArray[Any]], ticks_s: core.FloatArray
) -> tuple[core.TactileFrame, ...]:
    shape = (SAMPLES_PER_PROBE, *FRAME_SHAPE)
    films = {finger: values.get(features.PICTURES[finger], np.zeros(0)) for finger in core.FINGERS}
    return tuple(
        core.TactileFrame(finger, k, float(t_s), np.ascontiguousarray(film[k, ..., ::-1], np.uint8))
        for k, t_s in enumerate(ticks_s)
        for finger, film in films.items()
        if film.shape == shape
    )  # fmt: skip


def _label(values: Mapping[str, NDArray[Any]]) -> Label:
    """Return the offset of the file in integer µm; an empty label without one."""
    offset_mm = values.get(features.OFFSET, np.zeros(0)).reshape(-1)
    if offset_mm.size < 2:
        return NO_LABEL
    x_mm, y_mm = offset_mm[:2].astype(np.float64).tolist()
    if not (abs(x_mm) < MAX_OFFSET_MM and abs(y_mm) < MAX_OFFSET_MM):
        return NO_LABEL
    return Label(round(x_mm * 1e3), round(y_mm * 1e3))


MODE = "imported"
# Series of an imported episode, and whether its side of the split was ever set.
_BEGUN = f"""SELECT series, EXISTS (SELECT 1 FROM mark m WHERE m.episode = uuid
    AND m.name LIKE '{SPLIT_TAG}%') FROM episode WHERE uuid = ? AND mode = ?"""  # noqa: S608
OWN_BITS, NUMBER_AT = 24, 48


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Information that a foreign file lacks: the pair, and the labeller (None: unknown).

    ``mapping``: file that names its signals; the episodes are then the presses in it. ``cancelled``
    ends the reading of them.
    """

    actor: str
    labelled_by: str | None = None
    piece: str | None = None
    bottom: str | None = None
    mapping: Path | None = None
    cancelled: Event = NEVER


@dataclass(frozen=True, slots=True)
class ImportSurvey:
    """Preview of an import: numbers of new, known and unusable episodes, with reasons.

    ``contradictions``: what in the signals contradicts the mapping file; ``proposed``: values of
    it that may put that right.
    """

    found: int
    fit: int
    here: int
    problems: tuple[tuple[str, int], ...]
    losses: tuple[str, ...]
    contradictions: tuple[str, ...] = ()
    proposed: tuple[MappingChange, ...] = ()


class EpisodeImport:
    """One import of episodes: ``survey`` first, then ``write``.

    The constructor raises ``InputError`` for a manifest that does not fit its files, or if the pair
    is not named.
    """

    def __init__(self, dataset: Dataset, kind: str, source: Path, options: ImportOptions) -> None:
        if source.name.endswith(PARTIAL):
            raise core.InputError("This export was interrupted.", str(source), "Export it again.")
        self._dataset, self._kind, self._source, self._options = dataset, kind, source, options
        self._actor = check_person(options.actor)
        file = options.mapping
        self._mapping = None if file is None else read_settings(ImportMapping, file)
        self._manifest = read_manifest(source) if source.is_dir() and file is None else None
        self.presses: list[ForeignEpisode] = []
        """The presses of a mapped recording, from ``survey`` on."""
        self._named = _episodes_by_number(self._manifest, kind, source)
        spec = (self._manifest or {}).get("feature_spec")
        self.backup: Path | None = None
        """The catalogue as it was before ``write``; None until then, or of an empty dataset."""
        self._commanded = isinstance(spec, Mapping) and spec.get("action") == features.COMMANDED
        known = dataset.database.rows("SELECT uuid, piece, bottom FROM episode")
        self._known = {uuid: f"{piece} on {bottom}" for uuid, piece, bottom in known}
        self._geometry = "" if self._named else self._own_pair()
        self.total: int | None = len(self._named) or None

    def survey(self, advance: Callable[[int], None] = lambda done: None) -> ImportSurvey:
        """Read everything and report problems; nothing is written."""
        problems: Counter[str] = Counter()
        lost: dict[str, None] = {}
        found = fit = here = 0
        wanted = f"{self._options.piece} on {self._options.bottom}"
        for foreign in self._foreign():
            found += 1
            reason = self._reason(foreign)
            if reason:
                problems[reason] += 1
            elif self._is_here(foreign):
                here += 1
                if not self._named and (pair := self._known[self._uuid(foreign)]) != wanted:
                    lost |= {f"It is here as {pair}; another pair needs another dataset.": None}
            else:
                fit += 1
                lost |= dict.fromkeys(mapping_losses(foreign))
            advance(found)
        reasons, contradicted = tuple(sorted(problems.items())), list[Contradiction]()
        if self._mapping:
            grips = {(press.mounting, press.grip) for press in self.presses}
            if names := ", ".join(sorted({mounting for mounting, _ in grips if mounting})):
                lost[f"Grips: {len(grips)}; mountings: {names}."] = None
            changes = [measure_press(press) for press in self.presses]
            contradicted = contradictions(changes, self._mapping)
        return ImportSurvey(
            found, fit, here, reasons, tuple(lost), tuple(map(str, contradicted)),
            tuple(change for one in contradicted for change in one.changes),
        )  # fmt: skip

    def _foreign(self) -> Iterable[ForeignEpisode]:
        if self._mapping is None:
            return read_foreign(self._kind, self._source)
        file, cancel = self._options.mapping, self._options.cancelled
        presses = self.presses or (
            cut_press(episode, number, onset_s, self._mapping)
            for episode in read_foreign(self._kind, self._source, MAPPED_DEADLINE_S, file, cancel)
            for number, onset_s in enumerate(find_presses(episode.values))
        )
        # A copy of a recording in the same folder counts once.
        self.presses = list({self._uuid(press): press for press in presses}.values())
        return self.presses

    def write(self, advance: Callable[[int], None] = lambda done: None) -> list[str]:
        """Write the new episodes that can be mapped; return their ids.

        Raises ``FaultError`` before anything is written if the catalogue cannot be backed up.
        """
        self.backup = self._dataset.back_up_for("import")
        self._copy_geometry()
        series, written, sides = uuid7(), list[str](), list[tuple[str, str]]()
        for foreign in self._foreign():
            if self._reason(foreign):
                continue
            if self._is_here(foreign):
                # An interrupted import goes on in its series and grip, and sets its tags.
                begun = self._dataset.database.first(_BEGUN, (self._uuid(foreign), MODE))
                if begun is not None:
                    series = begun[0]
                    sides += [] if begun[1] else [(self._uuid(foreign), self._side(foreign))]
                continue
            written.append(self._record(foreign, series))
            sides.append((written[-1], self._side(foreign)))
            advance(len(written))
        self._record_import(series, len(written), sides)
        return written

    def _side(self, foreign: ForeignEpisode) -> str:
        """Return the side of the split of an episode, "" if it has none."""
        named = self._named.get(foreign.index)
        return foreign.side if named is None else str(named["split"])

    def _reason(self, foreign: ForeignEpisode) -> str:
        if self._named and foreign.index not in self._named:
            return "the manifest does not name it"
        return mapping_problem(foreign)

    def _is_here(self, foreign: ForeignEpisode) -> bool:
        named = self._named.get(foreign.index)
        return self._uuid(foreign) in self._known or bool(named and named["uuid"] in self._known)

    def _uuid(self, foreign: ForeignEpisode) -> str:
        """Return the id of an imported episode, which is the same for every import.

        It sorts like the original id, else like the number, so a later export has the same order.
        """
        number = foreign.index
        named = self._named.get(number)
        digest = sha256(_observation(foreign).tobytes())
        digest.update(str(named["uuid"] if named else number).encode("utf-8"))
        own = int.from_bytes(digest.digest()[:4], "big") >> (32 - OWN_BITS)
        if named is None:
            return uuid7_from_parts(
                0, number << NUMBER_AT | int.from_bytes(digest.digest()[:6], "big")
            )
        former = UUID(named["uuid"]).int
        return str(UUID(int=former >> OWN_BITS << OWN_BITS | own))

    def _record(self, foreign: ForeignEpisode, series: str) -> str:
        label = _label(foreign.values)
        origin = self._named.get(foreign.index)
        if origin is not None:
            label = Label(**origin["label"])
        else:
            # One grip for all episodes whose grips are unknown, so that no split can leak.
            origin = {
                "uuid": "",
                "piece": str(self._options.piece),
                "bottom": str(self._options.bottom),
                "geometry": self._geometry,
                "grip_id": f"{foreign.mounting or series}/{foreign.grip or 'unknown'}",
                "mounting_id": foreign.mounting or f"{series}/unknown",
                "source": "human" if self._options.labelled_by else "measured",
            }
        context = EpisodeContext(
            series=series, bottom=origin["bottom"], geometry=origin["geometry"], person=self._actor,
            grip_id=origin["grip_id"], mounting_id=origin["mounting_id"], mode=MODE,
            bench={"imported_from": self._kind},
        )  # fmt: skip
        uuid = self._uuid(foreign)
        offset = label.offset_mm if label.is_set else np.zeros(2)
        pairs = (("imported_as", origin["uuid"]),) if origin["uuid"] else ()
        recording = foreign.recording or _recording(foreign.values, commanded=self._commanded)
        onset_s = CONTACT_S if foreign.recording else 0.0
        episode = core.Episode(uuid, origin["piece"], _observation(foreign), offset, onset_s,
                          foreign.quality, recording, pairs)  # fmt: skip
        has_frames = recording is not None and bool(recording.frames)
        self._dataset.record(
            episode, label, source=origin["source"], context=context,
            keep_frames="jpeg95_444" if has_frames else "none",
        )  # fmt: skip
        return uuid

    def _own_pair(self) -> str:
        if self._options.piece is None or self._options.bottom is None:
            what = "The file does not say which pieces touched."
            fix = "Name them with --piece and --bottom."
            raise core.InputError(what, str(self._source), fix)
        pieces = load_pieces()
        top, bottom = pieces.top(self._options.piece), pieces.bottom(self._options.bottom)
        return self._dataset.geometry.store_pair(top, bottom)

    def _copy_geometry(self) -> None:
        """Copy the geometry records; each is checked against its name on use."""
        for name in self._manifest["geometry"] if self._manifest else ():
            path = self._dataset.geometry.folder / f"{name}.json"
            if not path.exists():
                core.write_atomically(path, (self._source / GEOMETRY / f"{name}.json").read_bytes())
        for named in self._named.values():
            self._dataset.geometry.pair(named["geometry"])

    def _record_import(self, series: str, count: int, sides: Sequence[tuple[str, str]]) -> None:
        """Store the sides of the split as tags in one operation, and the import in the audit."""
        with self._dataset.database.reading() as connection:
            marks = [
                read_mark(connection, uuid, f"{SPLIT_TAG}{side}", present=True)
                for uuid, side in sides
                if side
            ]
        body: dict[str, str | int] = {"format": self._kind, "episodes": count}
        note_import(self._dataset, self._actor, OperationDraft(marks=marks), series, body)
        self._dataset.labels.reload()


def _episodes_by_number(
    manifest: Manifest | None, kind: str, source: Path
) -> dict[int, Mapping[str, Any]]:
    if manifest is None:
        return {}
    said, fix = "The manifest cannot be used", "Export it again."
    with core.errors_as_input(said, source, fix, ValueError, KeyError, TypeError):
        if manifest["format"] != kind:
            raise ValueError(f"it is an export to {manifest['format']}, not {kind}")
        named = {int(e["export_index"]): e for e in manifest["episodes"]}
        for episode in named.values():
            label = Label(**episode["label"])
            _check(episode, label)
        names = [str(name) for name in manifest["geometry"]]
        if not all(len(name) == 64 and name.isalnum() for name in names):
            raise ValueError("a geometry record has a bad name")
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
