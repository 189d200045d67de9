"""Dataset folder: recording, reading, labels, merge and quality check of its episodes."""

from __future__ import annotations

import json
import math
import socket
import sqlite3
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.annotations import episode_index, operation_log, queues, reconciliation
from touchdown.backend.annotations.agreement import AgreementReport, compare_labellers
from touchdown.backend.annotations.backups import BackupStore
from touchdown.backend.annotations.consistency import (
    CheckedFolders,
    CheckProgress,
    ConsistencyProblem,
    DatasetParts,
    no_progress,
    problem_lines,
)
from touchdown.backend.annotations.database import (
    CATALOGUE_FILE,
    SCHEMA_VERSION,
    Database,
    add_event,
    catalogue_errors,
)
from touchdown.backend.annotations.episode_files import LOSSES, check_losses, read_packed
from touchdown.backend.annotations.episode_index import PAGE, PairCount, tagged_sides
from touchdown.backend.annotations.geometry_records import GeometryStore, TruePatch
from touchdown.backend.annotations.labels import (
    ARM_SOURCES,
    ARM_UM,
    BulkPreview,
    CarryCorrection,
    LabelStore,
)
from touchdown.backend.annotations.operation_log import OperationJournal
from touchdown.backend.annotations.queues import ScoreStore
from touchdown.backend.annotations.reconciliation import (
    MergeReport,
    check_dataset,
    open_findings,
    reconcile,
)
from touchdown.backend.annotations.review import check_person
from touchdown.backend.annotations.run_tracking import RunTracker
from touchdown.backend.annotations.storage import WriterLock, check_local_disk, disk_weakness
from touchdown.backend.annotations.training_set import stored_observation
from touchdown.backend.annotations.values import (
    EpisodeContext,
    EpisodeEntry,
    EpisodeFilter,
    Label,
    LabelContent,
    Revision,
    Source,
    follow_uuid,
    uuid7,
)
from touchdown.backend.core import (
    Episode,
    FaultError,
    InputError,
    RefusedError,
    disk_errors,
    parse_json,
    program_stamp,
    write_atomically,
)
from touchdown.backend.episodes import (
    CompressedEpisode,
    ExaminedEpisode,
    KeepFrames,
    QualityIssue,
    check_quality,
    divided_indices,
    read_compressed_episode,
    read_episode,
    without_images,
)

DESCRIPTION_FILE = "dataset.json"


@dataclass(frozen=True, slots=True)
class DatasetDescription:
    """Content of ``dataset.json``. ``site``: hash chain that this copy of the dataset writes.

    ``home``: computer and folder where the site was created. A copy in another place starts its own
    site, so two copies never continue the same chain.
    """

    uuid: str
    site: str
    home: str
    schema_version: int
    created_by: str

    @property
    def is_newer(self) -> bool:
        """True if a later program wrote it: it is opened for reading only."""
        return self.schema_version > SCHEMA_VERSION


class Dataset:
    """Episodes, labels and geometry of one folder.

    Open one with ``Dataset.open``; close it with a ``with`` block or ``close``. Iterating yields
    the entries of all episodes that are not deleted, oldest first. All methods are thread-safe.

    Attributes
    ----------
    folder : Path
        Folder of the dataset.
    description : DatasetDescription
        Content of ``dataset.json``.
    labels : LabelStore
        Labels with their revisions, undo and review.
    geometry : GeometryStore
        Faces and offsets that the labels refer to; derives contact patches from them.
    runs : RunTracker
        Runs recorded in the dataset.
    notices : tuple of str
        Problems found or repaired on opening, one sentence each; losses until they are resolved.
    problems : list of ConsistencyProblem
        The same problems, one by one.
    backup_trouble : str
        Reason why the last backup of the catalogue failed; empty if it succeeded.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Dataset.open(folder) as dataset:
    ...     [dataset.read(entry.uuid).observation.shape for entry in dataset]
    []

    """

    def __init__(
        self,
        folder: Path,
        description: DatasetDescription,
        database: Database,
        lock: WriterLock | None,
    ) -> None:
        self.folder: Path = folder
        self.description: DatasetDescription = description
        self.database: Database = database
        self._lock = lock
        self._checked = CheckedFolders()
        self.notices: tuple[str, ...] = ()
        self.problems: list[ConsistencyProblem] = []
        self.geometry: GeometryStore = GeometryStore(folder / "geometry")
        self.journal: OperationJournal = OperationJournal(folder / "labels")
        self.labels: LabelStore = LabelStore(database, self.journal, description.site)
        self.scores: ScoreStore = ScoreStore(database)
        self.runs: RunTracker = RunTracker(folder, self.labels.chain_heads)
        self.backups: BackupStore = BackupStore(database, folder / "backup")
        self.backup_trouble: str = ""
        self.labels.after_commit = partial(self._back_up, self.backups.hourly)
        before_bulk = partial(self.backups.if_changed, "bulk")
        self.labels.before_bulk = partial(self._back_up, before_bulk)

    @classmethod
    def open(
        cls,
        folder: Path | str,
        *,
        create: bool = True,
        write: bool = True,
        person: str = "",
        progress: CheckProgress = no_progress,
    ) -> Self:
        """Open a dataset, or create it.

        Opening for writing takes the lock of the dataset and repairs what a crash left behind.
        Readers need no lock, and one writer and any number of readers work at the same time.

        Parameters
        ----------
        folder : Path or str
            Folder of the dataset, on a local disk.
        create : bool
            Create the dataset if there is none (only with ``write``).
        write : bool
            Open for writing.
        person : str
            Name shown to others who want to write (default: the user account).
        progress : callable
            Receives what is checked, and numbers of checked and of all. After a crash every file
            is looked at, which takes minutes in a large dataset on a cold disk.

        Returns
        -------
        Dataset
            The open dataset.

        Raises
        ------
        DatasetInUseError
            If another process has it open for writing; the error names the writer.
        InputError
            If there is no dataset, its catalogue is damaged, or the disk is a network drive.

        """
        folder = Path(folder)
        check_local_disk(folder)
        is_there = (folder / DESCRIPTION_FILE).is_file()
        if not is_there and not (create and write):
            fix = "Collect probes first, or name the folder that holds dataset.json."
            raise InputError("There is no dataset.", str(folder), fix)
        lock = WriterLock.take(folder, person) if write else None
        try:
            description = _describe(folder) if write else read_description(folder)
            database = Database.open(
                folder / CATALOGUE_FILE, write=write and not description.is_newer
            )
        except BaseException:
            if lock is not None:
                lock.close()
            raise
        dataset = cls(folder, description, database, lock)
        try:
            with catalogue_errors(database.path):
                dataset._reconcile(progress)
        except BaseException:
            dataset.close()
            raise
        return dataset

    @property
    def newer_writer(self) -> str:
        """Program and schema of a dataset or catalogue from a later program, else ""."""
        told = self.description
        number = max(told.schema_version, self.database.schema_version)
        by = told.created_by if told.is_newer else "a newer version"
        return f"{by} (schema {number})" if number > SCHEMA_VERSION else ""

    def _reconcile(self, progress: CheckProgress) -> None:
        if self.writable:
            self._checked = CheckedFolders.take(self.database)
            self.problems = reconcile(replace(self.parts, progress=progress))
            follow_uuid(self.database.one("SELECT coalesce(max(uuid), '') FROM episode")[0])
            self.labels.frozen = " ".join(one.message for one in self.problems if one.locks)
            weakness = disk_weakness(self.folder)
            self.notices = (*problem_lines(self.problems), *filter(None, (weakness,)))
        elif self._lock is not None:
            self.notices = (
                f"The dataset was written by {self.newer_writer}: open for reading only. "
                "Open it with the Touchdown that wrote it.",
            )
        else:
            self.problems = [*check_losses(self.parts, whole=False), *open_findings(self.parts)]
            self.notices = problem_lines(self.problems)

    def verify(self, progress: CheckProgress) -> list[ConsistencyProblem]:
        """Read every file and label operation, and return all damage until it is resolved.

        Damage is recorded if the dataset is open for writing. What opening repaired is returned
        as well. ``progress`` receives what is checked, and numbers of checked and of all. Raises
        ``InputError`` if the catalogue cannot be read.
        """
        parts = replace(self.parts, progress=progress)
        with catalogue_errors(self.database.path):
            if self.writable:
                found = reconcile(parts, whole=True, again=True)
            else:
                found = list(check_dataset(parts, whole=True))
            targets = {problem.target for problem in found}
            # Losses of episodes are among the found ones, unless resolved since the opening.
            before = [
                problem
                for problem in self.problems
                if problem.target not in targets and not self.entries([problem.target])
            ]
        return [problem for problem in (*before, *found) if problem.is_damage]

    def resolve(self, person: str, *kinds: str) -> list[ConsistencyProblem]:
        """Mark repaired damage (default: of all kinds) as resolved by ``person``; return it.

        It is not listed again. A lost recording stays listed until its file is back or the episode
        is deleted.
        """
        done = reconciliation.resolve_findings(self.parts, check_person(person), *kinds)
        closed = {(one.kind, one.target) for one in done}
        self.problems = [p for p in self.problems if (p.kind, p.target) not in closed]
        return done

    @property
    def parts(self) -> DatasetParts:
        """Parts that checks and repairs use."""
        site = self.description.site
        return DatasetParts(
            self.folder, self.database, self.journal, self.geometry, site, self._checked
        )

    def _back_up(self, make: Callable[[], object]) -> None:
        """Run a backup; a failure is kept in ``backup_trouble`` and never raised."""
        if not self.writable:
            return
        try:
            make()
            self.backup_trouble = ""
        except FaultError as error:
            self.backup_trouble = str(error)

    def back_up_for(self, reason: str) -> Path | None:
        """Make sure that a verified backup holds every operation; return its path.

        None if there is no operation yet. Raises ``FaultError`` if the backup fails: the action
        ``reason`` must then not be done.
        """
        return self.backups.if_changed(reason) or self.backups.newest()

    @property
    def writable(self) -> bool:
        """True if this object may write the dataset."""
        return self.database.writable

    def record(
        self,
        episode: Episode,
        label: Label,
        *,
        source: Source,
        context: EpisodeContext,
        keep_frames: KeepFrames = "jpeg95_444",
    ) -> EpisodeEntry:
        """Store ``episode`` and its first label; both are durable on return.

        Raises ``FaultError`` if the disk fails; the episode can then be recorded again.
        """
        self.labels.refuse_if_frozen()
        episode = episode_index.with_uuid(episode)
        message = episode_index.label_message(episode, label, source, context, time.time_ns())
        row = episode_index.write_episode_file(self.folder, episode, message, context, keep_frames)
        content = LabelContent(label, source, context.geometry)
        with self.labels.commit() as connection:
            site = self.description.site
            episode_index.enter_episode(connection, site, row, content, "record")
        return self.entry(episode.episode_id)

    def __iter__(self) -> Iterator[EpisodeEntry]:
        page = self.episodes(EpisodeFilter(limit=PAGE))
        while page:
            yield from page
            page = self.episodes(EpisodeFilter(limit=PAGE, after=page[-1].uuid))

    def entry(self, uuid: str) -> EpisodeEntry:
        """Return one entry; raises ``InputError`` if there is no such episode."""
        found = self.entries([uuid])
        if not found:
            raise InputError("There is no such episode.", uuid, "List the episodes of the dataset.")
        return found[uuid]

    def entries(self, uuids: Iterable[str]) -> dict[str, EpisodeEntry]:
        """Return the entries of these episodes; unknown ids are left out."""
        columns, tables = episode_index.COLUMNS, episode_index.TABLES
        listed = "(SELECT value FROM json_each(?))"
        sql = f"SELECT {columns} FROM {tables} WHERE e.uuid IN {listed}"  # noqa: S608
        rows = self.database.rows(sql, (json.dumps(list(uuids)),))
        return {row[0]: episode_index.row_to_entry(row) for row in rows}

    def episodes(self, wanted: EpisodeFilter | None = None) -> list[EpisodeEntry]:
        """Return the entries that pass the filter (default: all but deleted), oldest first."""
        return episode_index.find_episodes(self.database, wanted or EpisodeFilter())

    def path(self, uuid: str) -> Path:
        """Return the file of an episode, or the pack that contains it."""
        return self.folder / self.entry(uuid).path

    def read(self, uuid: str) -> Episode:
        """Read the signals of an episode.

        Parameters
        ----------
        uuid : str
            Id of the episode (``EpisodeEntry.uuid``).

        Returns
        -------
        Episode
            Observation (20, 258) at 10 Hz and the recording, if the file holds one. An episode in
            a pack has neither recording nor images.

        Raises
        ------
        InputError
            If there is no such episode, or its file is damaged; the error names the file.

        """
        return self._packed(uuid) or read_episode(self.path(uuid))

    def film(self, uuid: str) -> CompressedEpisode:
        """Read an episode with compressed images; an episode in a pack has none."""
        packed = self._packed(uuid)
        return without_images(packed) if packed else read_compressed_episode(self.path(uuid))

    def _packed(self, uuid: str) -> Episode | None:
        path = self.path(uuid)
        sql = "SELECT chunk_off, chunk_len FROM episode WHERE uuid = ?"
        offset, length = self.database.one(sql, (uuid,))
        if offset is None:
            return None
        return replace(read_packed(path, (offset, length)), episode_id=uuid)

    def patch(self, uuid: str) -> TruePatch:
        """Return the true patch of the valid label, derived from the geometry."""
        head = self.labels.head(uuid)
        return self.geometry.patch(head.geometry, head.label)

    def carried(self, person: str, corrected: Revision) -> BulkPreview:
        """Return the change that corrects the other probes of a grip as one of them was corrected.

        Grasp and bottom hold still within a grip, so that all its labels by the arm have nearly the
        same error. Changes drafts by the arm only. Without a label or one by the arm, it is empty.
        """
        entry, first = self.entry(corrected.episode), self.labels.history(corrected.episode)[0]
        uuids, (dx_um, dy_um) = list[str](), (0, 0)
        known = first.label.is_set and corrected.label.is_set
        if known and first.source in ARM_SOURCES and entry.grip != entry.uuid:
            moved_mm = corrected.label.offset_mm - first.label.offset_mm
            dx_um, dy_um = np.rint(1e3 * moved_mm).astype(int).tolist()
            like = EpisodeFilter(
                ("draft",), series=entry.series, grip_id=entry.grip_id, accepted=True
            )
            uuids = [other.uuid for other in self.episodes(like) if other.uuid != entry.uuid]
        sigma_um = round(math.hypot(corrected.label.sigma_um or 0, ARM_UM))
        change = CarryCorrection(dx_um, dy_um, sigma_um, corrected.source)
        return self.labels.preview(person, uuids, change)

    def queue(
        self, name: str, person: str, *, seed: int = 0, limit: int | None = None, wanted: str = ""
    ) -> list[str]:
        """Return the episodes of a queue for ``person``; ``wanted`` is the filter of "all"."""
        return queues.episode_queue(
            self.database, name, person, seed=seed, wanted=wanted, limit=limit
        )

    def uuids(self) -> set[str]:
        """Return the ids of all episodes that are not deleted."""
        sql = f"SELECT e.uuid FROM {episode_index.TABLES} WHERE NOT h.deleted"  # noqa: S608
        return {uuid for (uuid,) in self.database.rows(sql)}

    def count_by_pair(self) -> list[PairCount]:
        """Return the numbers of episodes by pair, label state and file state, deleted included."""
        state = "CASE WHEN h.deleted THEN 'deleted' ELSE h.state END"
        columns = f"e.piece, e.bottom, {state}, e.state, count(*), sum(h.conflict)"
        sql = f"SELECT {columns} FROM {episode_index.TABLES} GROUP BY 1, 2, 3, 4"  # noqa: S608
        return [PairCount(*row) for row in self.database.rows(f"{sql} ORDER BY 1, 2, 3, 4")]

    def counts(self) -> dict[str, int]:
        """Return the number of episodes by "unlabelled", "draft" or stage: review, approved, ..."""
        stage = "CASE stage WHEN 'unlabelled' THEN state ELSE stage END"
        sql = f"SELECT {stage}, count(*) FROM label_head GROUP BY 1 ORDER BY 1"  # noqa: S608
        return dict(self.database.rows(sql))

    def merge(self, person: str, other: Path) -> MergeReport:
        """Merge labels and episodes of another copy of this dataset; that copy is not changed.

        Files are copied before rows and operations. Raises ``InputError`` for another dataset or a
        broken chain of labels, ``FaultError`` if the disk fails.
        """
        name = check_person(person)
        if other.resolve() == self.folder.resolve():
            raise InputError("This is the dataset itself.", str(other), "Name a copy of it.")
        with Dataset.open(other, create=False, write=False) as theirs:
            if theirs.description.uuid != self.description.uuid:
                what = "This is another dataset, not a copy of the same one."
                fix = "Merge copies of one dataset; import other data."
                raise InputError(what, str(other), fix)
            self._back_up(partial(self.backups.if_changed, "merge"))
            paths = [path for (path,) in theirs.database.rows("SELECT DISTINCT path FROM episode")]
            try:
                missing = reconciliation.copy_files(self.folder, other, paths)
            except OSError as error:
                raise FaultError(reconciliation.copy_fault(error, self.folder)) from error
            with theirs.database.reading() as connection:
                log = operation_log.read_operations(connection)
            with self.labels.commit() as connection:
                count = reconciliation.merge_episodes(
                    connection, theirs.database, self.folder, missing
                )
                done = reconciliation.merge_labels(connection, log, str(other), episodes=count)
                body = {"operations": done.operations, "episodes": done.episodes}
                body |= {"conflicts": len(done.conflicts)}
                add_event(connection, name, "merge", str(other), body)
        self.labels.reload()
        return done

    def compare(self, first: str, second: str) -> AgreementReport:
        """Return the agreement of two persons."""
        return compare_labellers(self.database, self.geometry, first, second)

    def people(self) -> list[str]:
        """Return the names of all persons who changed labels."""
        return self.labels.people()

    def close(self) -> None:
        """Back up, close the catalogue and release the lock. A second call has no effect."""
        if self._lock is not None:
            with suppress(FaultError, RefusedError, sqlite3.Error):
                self._back_up(partial(self.backups.if_changed, "close"))
                # Without it the next opening checks every folder.
                self._checked.keep(self.database)
        self.database.close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _describe(folder: Path) -> DatasetDescription:
    """Return the description; create it, or start a new site if the folder was moved."""
    home = f"{socket.gethostname()}:{folder.resolve()}"
    path = folder / DESCRIPTION_FILE
    if not path.is_file():
        found = DatasetDescription(uuid7(), uuid7(), home, SCHEMA_VERSION, program_stamp())
    else:
        found = read_description(folder)
        if found.home == home or found.is_newer:
            return found
        found = replace(found, site=uuid7(), home=home)
    content = {name: getattr(found, name) for name in DatasetDescription.__slots__}
    frames = {"O": "bottom face", "F": "grasped face"}
    content |= {"units": {"length": "um", "angle": "mdeg", "time": "ns"}, "frames": frames}
    fix = "Free some space, or name a folder that can be written."
    with disk_errors("The dataset cannot be written", path, fix):
        write_atomically(path, json.dumps(content, indent=2).encode("utf-8"))
    return found


def read_description(folder: Path) -> DatasetDescription:
    """Read ``dataset.json``; raises ``InputError`` if it cannot be read."""
    path = folder / DESCRIPTION_FILE
    try:
        content = parse_json(path.read_bytes())
        facts = {name: content[name] for name in DatasetDescription.__slots__}
        version = facts.pop("schema_version")
        if type(version) is not int or not all(isinstance(v, str) for v in facts.values()):
            raise TypeError("a value is of another type")
        return DatasetDescription(**facts, schema_version=version)
    except (OSError, ValueError, KeyError, TypeError) as error:
        what, fix = "The description of the dataset cannot be read.", "Restore it from a copy."
        raise InputError(what, str(path), fix) from error


Progress = Callable[[int, int], bool]  # called with (done, total) after each episode; False stops


@dataclass(frozen=True, slots=True)
class QualityReport:
    """``findings`` of the ``examined`` examined episodes, out of ``count``."""

    findings: tuple[QualityIssue, ...]
    examined: int
    count: int


def check_dataset_quality(dataset: Dataset, progress: Progress) -> QualityReport:
    """Examine every episode that is not deleted, until ``progress`` returns False.

    Distribution and duplicates are checked per pair of pieces. Unreadable episodes are findings.
    """
    listed = dataset.episodes()
    entries = [entry for entry in listed if entry.file_state == "complete"]
    pairs: dict[tuple[str, str], list[ExaminedEpisode]] = defaultdict(list)
    found, examined = list(_divided(dataset, entries)), 0
    for entry in listed:
        if loss := LOSSES.get(entry.file_state):
            found.append(QualityIssue("unreadable", (entry.uuid,), f"Its file {loss}."))
    for entry, seen in iter_observations(dataset, entries):
        examined += 1
        if isinstance(seen, InputError):
            found.append(QualityIssue("unreadable", (entry.uuid,), seen.what))
        else:
            offset_mm = dataset.labels.head(entry.uuid).label.offset_mm
            pair = pairs[entry.piece, entry.bottom]
            pair.append(ExaminedEpisode.of(entry.uuid, seen, offset_mm, entry.quality))
        if not progress(examined, len(entries)):
            break
    for names, rows in pairs.items():
        uuids = tuple(row.uuid for row in rows)
        for issue in check_quality(rows):
            text = f"{names[0]} on {names[1]}: {issue.text}"
            found.append(issue if issue.episodes else QualityIssue(issue.kind, uuids, text))
    return QualityReport(tuple(found), examined, len(entries))


def iter_observations(
    dataset: Dataset, entries: Iterable[EpisodeEntry]
) -> Iterator[tuple[EpisodeEntry, NDArray[np.float32] | InputError]]:
    """Yield the observation (20, 258) of each episode, or the error if it cannot be read."""
    sql = "SELECT uuid, chunk_off, chunk_len FROM episode WHERE chunk_off IS NOT NULL"
    chunks = {uuid: (offset, length) for uuid, offset, length in dataset.database.rows(sql)}
    for entry in entries:
        try:
            yield entry, stored_observation(dataset.folder / entry.path, chunks.get(entry.uuid))
        except InputError as error:
            yield entry, error


def _divided(dataset: Dataset, entries: list[EpisodeEntry]) -> Iterator[QualityIssue]:
    """Yield the pairs of a series that tags put on both sides of the split."""
    tagged = tagged_sides(dataset.database)
    if not tagged:
        return
    sides = [tagged.get(entry.uuid, "train") for entry in entries]
    series = [(entry.mounting_id, entry.piece, entry.bottom) for entry in entries]
    groups: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for k in divided_indices(sides, series).tolist():
        groups[series[k]].append(entries[k].uuid)
    for (mounting, piece, bottom), uuids in groups.items():
        text = f"Tags put {piece} on {bottom} of mounting {mounting} on both sides of the split."
        yield QualityIssue("divided series", tuple(uuids), text)
