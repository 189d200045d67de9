"""One dataset folder, as window, campaign and command line hold it."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Self

from backend.catalogue import episodes, merge, operations, queues, recording
from backend.catalogue.backups import Backups
from backend.catalogue.checked_folders import CheckedFolders
from backend.catalogue.comparison import Comparison, compare
from backend.catalogue.database import NAME as CATALOGUE
from backend.catalogue.database import Database
from backend.catalogue.findings import Store, sentences
from backend.catalogue.geometry import GeometryStore, TruePatch
from backend.catalogue.journal import Journal
from backend.catalogue.labels import LabelBook
from backend.catalogue.local_disk import refuse_network, weakness
from backend.catalogue.merge import Merged
from backend.catalogue.packs import read_packed
from backend.catalogue.recovery import reconcile
from backend.catalogue.review import check_person
from backend.catalogue.runs import RunBook
from backend.catalogue.schema import SCHEMA_VERSION
from backend.catalogue.scores import Scores
from backend.catalogue.uuid7 import follow, uuid7
from backend.catalogue.values import (
    Content,
    EpisodeContext,
    EpisodeEntry,
    EpisodeFilter,
    Label,
    Source,
)
from backend.catalogue.writer_lock import WriterLock
from backend.core.faults import FaultError, InputError, RefusedError
from backend.core.files import make_folder, write_atomically
from backend.core.flow import Episode
from backend.core.program import program
from backend.dataset.episode_reading import read_episode
from backend.dataset.film_reading import FilmedEpisode, read_film, without_pictures
from backend.dataset.pictures import KeepFrames

DESCRIPTION = "dataset.json"


@dataclass(frozen=True, slots=True)
class Description:
    """``dataset.json``: what the dataset is. ``site``: the chain that this copy of it writes.

    ``home``: computer and folder where the site was begun. A copy elsewhere begins its own, so
    that two copies never continue one chain in two ways.
    """

    uuid: str
    site: str
    home: str
    schema_version: int
    created_by: str


class Dataset:
    """Episodes, labels and geometry of one folder. Every call may come from any thread.

    ``notices``: what opening found, a sentence each. ``backup_trouble``: why the newest copy of
    the catalogue failed, or "". Use it as a context, or ``close`` it.
    """

    def __init__(
        self,
        folder: Path,
        description: Description,
        database: Database,
        lock: WriterLock | None,
    ) -> None:
        self.folder, self.description, self.database = folder, description, database
        self._lock = lock
        self._checked = CheckedFolders()
        self.notices: tuple[str, ...] = ()
        self.geometry = GeometryStore(folder / "geometry")
        self.journal = Journal(folder / "labels")
        self.labels = LabelBook(database, self.journal, description.site)
        self.scores = Scores(database)
        self.runs = RunBook(folder, database, self.labels.chain_heads)
        self.backups = Backups(database, folder / "backup")
        self.backup_trouble = ""
        self.labels.after_commit = partial(self._back_up, self.backups.hourly)
        before_bulk = partial(self.backups.if_changed, "bulk")
        self.labels.before_bulk = partial(self._back_up, before_bulk)

    @classmethod
    def open(
        cls, folder: Path, *, create: bool = True, write: bool = True, person: str = ""
    ) -> Self:
        """Open the dataset ``folder``, or make it where ``create`` allows.

        To write, it takes the lock in the name of ``person`` (default: the account): raises
        ``DatasetInUseError`` naming the other writer. Raises ``InputError`` for a network file
        system, a folder that is no dataset, or a damaged catalogue.
        """
        refuse_network(folder)
        is_there = (folder / DESCRIPTION).is_file()
        if not is_there and not (create and write):
            raise InputError(
                "There is no dataset.",
                str(folder),
                "Collect probes first ('touchdown collect', or Ctrl+2 in the window), or name the "
                "folder that holds dataset.json.",
            )
        make_folder(folder)
        lock = WriterLock.take(folder, person) if write else None
        try:
            description = _describe(folder) if write else read_description(folder)
            database = Database.open(folder / CATALOGUE, write=write)
        except BaseException:
            if lock is not None:
                lock.release()
            raise
        dataset = cls(folder, description, database, lock)
        try:
            dataset._reconcile()
        except BaseException:
            dataset.close()
            raise
        return dataset

    def _reconcile(self) -> None:
        if self.writable:
            self._checked = CheckedFolders.take(self.database)
            found = reconcile(self.store)
            follow(self.database.one("SELECT coalesce(max(uuid), '') FROM episode")[0])
            self.labels.frozen = " ".join(finding.said for finding in found if finding.locks)
            self.notices = (*sentences(found), *filter(None, (weakness(self.folder),)))
        elif self._lock is not None:
            self.notices = (
                "The catalogue was written by a newer version of Touchdown: open for reading only.",
            )

    @property
    def store(self) -> Store:
        """The parts that checks and repairs work on."""
        site = self.description.site
        return Store(self.folder, self.database, self.journal, self.geometry, site, self._checked)

    def _back_up(self, make: Callable[[], object]) -> None:
        """Make a copy where one is due; a copy that fails never fails what it follows."""
        if not self.writable:
            return
        try:
            make()
            self.backup_trouble = ""
        except FaultError as error:
            self.backup_trouble = str(error)

    def back_up_for(self, reason: str) -> Path | None:
        """Make sure that a checked copy holds every operation; returns it (None: no operation yet).

        Raises ``FaultError`` if it cannot be made: then do not do what it was for.
        """
        return self.backups.if_changed(reason) or self.backups.newest()

    @property
    def writable(self) -> bool:
        """Whether this dataset may be written here."""
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
        """Make ``episode`` and its first label durable; returns when both are.

        Raises ``FaultError`` if the disk refuses: the caller still holds the episode.
        """
        self.labels.refuse_if_frozen()
        episode = recording.with_uuid(episode)
        message = episodes.label_message(episode, label, source, context, time.time_ns())
        written = recording.write_file(self.folder, episode, message, context, keep_frames)
        content = Content(label, source, context.geometry)
        with self.labels.commit() as connection:
            site = self.description.site
            recording.enter(connection, site, written.row, content, "record")
        return self.entry(episode.episode_id)

    def entry(self, uuid: str) -> EpisodeEntry:
        """Return one entry; raises ``InputError`` if there is no such episode."""
        found = episodes.entry(self.database, uuid)
        if found is None:
            raise InputError("There is no such episode.", uuid, "List the episodes of the dataset.")
        return found

    def episodes(self, wanted: EpisodeFilter | None = None) -> list[EpisodeEntry]:
        """Return the entries that pass the filter (default: all but deleted), oldest first."""
        return episodes.find(self.database, wanted or EpisodeFilter())

    def path(self, uuid: str) -> Path:
        """Return the file of an episode; of a packed one its pack, which holds no pictures."""
        return self.folder / self.entry(uuid).path

    def read(self, uuid: str) -> Episode:
        """Read the signals of an episode; raises ``InputError`` naming a damaged file."""
        packed = self._packed(uuid)
        return read_episode(self.path(uuid)) if packed is None else packed

    def film(self, uuid: str) -> FilmedEpisode:
        """Read an episode for looking at it, pictures still compressed; a packed one has none."""
        packed = self._packed(uuid)
        return read_film(self.path(uuid)) if packed is None else without_pictures(packed)

    def _packed(self, uuid: str) -> Episode | None:
        path = self.path(uuid)
        sql = "SELECT chunk_off, chunk_len FROM episode WHERE uuid = ?"
        offset, length = self.database.one(sql, (uuid,))
        if offset is None:
            return None
        return replace(read_packed(path, (offset, length)), episode_id=uuid)

    def patch(self, uuid: str) -> TruePatch:
        """Return the true patch of the label that holds, derived from the geometry."""
        head = self.labels.head(uuid)
        return self.geometry.patch(head.geometry, head.label)

    def queue(
        self, name: str, person: str, *, seed: int = 0, limit: int | None = None
    ) -> list[str]:
        """Return the episodes that ``person`` should see next, in order (``queues.queue``)."""
        return queues.queue(self.database, name, person, seed=seed, limit=limit)

    def counts(self) -> dict[str, int]:
        """Return how many episodes are unlabelled, in review, approved, rejected, ..."""
        return queues.counts(self.database)

    def merge(self, person: str, other: Path) -> Merged:
        """Bring in labels and episodes of another copy, which stays as it is.

        Files first, rows and operations second. Raises ``InputError`` for another dataset, or a
        chain of labels that is broken or does not fit, ``FaultError`` if the disk refuses.
        """
        name = check_person(person)
        with Dataset.open(other, create=False, write=False) as theirs:
            if theirs.description.uuid != self.description.uuid:
                raise InputError(
                    "This is another dataset, not a copy of the same one.",
                    str(other),
                    "Merge copies of one dataset; bring other data in with 'touchdown import'.",
                )
            self._back_up(partial(self.backups.if_changed, "merge"))
            paths = [path for (path,) in theirs.database.rows("SELECT DISTINCT path FROM episode")]
            try:
                missing = merge.copy_files(self.folder, other, paths)
            except OSError as error:
                raise FaultError(merge.not_copied(error, self.folder)) from error
            with theirs.database.reading() as connection:
                log = operations.read_operations(connection)
            with self.labels.commit() as connection:
                count = merge.take_rows(connection, theirs.database, self.folder, missing)
                done = merge.take_labels(connection, log, str(other), episodes=count)
                merge.note(connection, name, other, done)
        self.labels.take_stock()
        return done

    def compare(self, first: str, second: str) -> Comparison:
        """Return how far the answers of two persons agree."""
        return compare(self.database, self.geometry, first, second)

    def people(self) -> list[str]:
        """Return the names of all who ever acted here."""
        return self.labels.people()

    def close(self) -> None:
        """Back up, close the catalogue and let others write; closing twice does no harm."""
        if self._lock is not None:
            self._back_up(partial(self.backups.if_changed, "close"))
            with suppress(FaultError, RefusedError):
                # Without it the next start takes longer, and that is all.
                self._checked.keep(self.database)
        self.database.close()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _describe(folder: Path) -> Description:
    """Return the description, made or moved to a new site where that is due."""
    home = f"{socket.gethostname()}:{folder.resolve()}"
    path = folder / DESCRIPTION
    if not path.is_file():
        found = Description(uuid7(), uuid7(), home, SCHEMA_VERSION, program())
    else:
        found = read_description(folder)
        if found.home == home:
            return found
        found = replace(found, site=uuid7(), home=home)
    content = {name: getattr(found, name) for name in Description.__slots__}
    frames = {"O": "bottom face", "F": "grasped face"}
    content |= {"units": {"length": "um", "angle": "mdeg", "time": "ns"}, "frames": frames}
    write_atomically(path, json.dumps(content, indent=2).encode("utf-8"))
    return found


def read_description(folder: Path) -> Description:
    """Return what ``dataset.json`` says; raises ``InputError`` if it cannot be read."""
    path = folder / DESCRIPTION
    try:
        content = json.loads(path.read_text("utf-8"))
        return Description(**{name: content[name] for name in Description.__slots__})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "The description of the dataset cannot be read.", str(path), "Restore it from a copy."
        ) from error
