"""Verified backups of the index."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from touchdown.backend import core
from touchdown.backend.annotations.consistency import QUARANTINE
from touchdown.backend.annotations.database import (
    APPLICATION_ID,
    CATALOGUE_FILE,
    Database,
    add_event,
)
from touchdown.backend.annotations.operation_log import newest_operations
from touchdown.backend.annotations.storage import WriterLock

STAMP = "%Y%m%dT%H%M%S%fZ"
INTERVAL = timedelta(hours=1)
# Retention: the newest copy of each of the last 24 hours, 14 days and 12 months.
RETENTION = (("%Y%m%d%H", 24), ("%Y%m%d", 14), ("%Y%m", 12))

Heads = dict[str, tuple[int, str]]  # per site: number and hash of its newest operation


@dataclass(frozen=True, slots=True)
class Backup:
    """One backup of the catalogue and its time (UTC)."""

    path: Path
    made: datetime


def list_backups(folder: Path) -> list[Backup]:
    """Return the backups in ``folder``, newest first."""
    found = []
    for path in folder.glob("catalog-*.db"):
        try:
            made = datetime.strptime(path.stem.removeprefix("catalog-"), STAMP)
        except ValueError:
            continue
        found.append(Backup(path, made.replace(tzinfo=UTC)))
    return sorted(found, key=lambda backup: backup.made, reverse=True)


def surplus_backups(backups: Iterable[Backup]) -> list[Backup]:
    """Return the backups that the retention rule no longer keeps."""
    ordered = sorted(backups, key=lambda backup: backup.made, reverse=True)
    wanted: set[Path] = set()
    for form, count in RETENTION:
        newest: dict[str, Path] = {}
        for backup in ordered:
            newest.setdefault(backup.made.strftime(form), backup.path)
        wanted.update(list(newest.values())[:count])
    return [backup for backup in ordered if backup.path not in wanted]


def check_backup(path: Path) -> Heads:
    """Check a backup with SQLite and return its heads; raises ``InputError`` if it is damaged."""
    core.check_file(path, "Use another backup.")
    try:
        # Immutable: a finished copy is never written, so no -wal or -shm file is needed.
        address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as connection:
            (verdict,) = connection.execute("PRAGMA integrity_check").fetchone()
            (ours,) = connection.execute("PRAGMA application_id").fetchone()
            if verdict != "ok" or ours != APPLICATION_ID:
                raise _bad(path, verdict if verdict != "ok" else "it is no catalogue")
            return newest_operations(connection)
    except sqlite3.Error as error:
        raise _bad(path, str(error)) from error


class BackupStore:
    """Backups of one open catalogue."""

    def __init__(
        self,
        database: Database,
        folder: Path,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._database, self._folder, self._now = database, folder, now
        copies = list_backups(folder)
        self._last = copies[0].made if copies else None
        self._saved: Heads | None = None

    @property
    def age(self) -> timedelta | None:
        """Time since the newest backup; None if there is none."""
        return None if self._last is None else self._now() - self._last

    def newest(self) -> Path | None:
        """Return the newest backup, None if there is none."""
        return next((backup.path for backup in list_backups(self._folder)), None)

    def make(self, reason: str, *, prune: bool = True) -> Path:
        """Copy, verify and name the catalogue, then ``prune`` old backups.

        Readers continue during the copy; writers wait. Raises ``FaultError`` if the copy fails.
        """
        made = self._now()
        path = self._folder / f"catalog-{made.strftime(STAMP)}.db"
        part = self._folder / f".{path.name}.tmp"
        with _disk_errors(self._folder):
            core.make_folder(self._folder)
            try:
                self._copy(part)
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)
            core.sync_folder(self._folder)
            for old in surplus_backups(list_backups(self._folder)) if prune else ():
                old.path.unlink()
        self._last = made
        if self._database.writable:
            with self._database.transaction() as connection:
                add_event(connection, "program", "backup", path.name, {"reason": reason})
        return path

    def hourly(self) -> Path | None:
        """Make a backup if labels changed and the newest one is older than an hour."""
        age = self.age
        # A backup dated in the future was made before the clock was set back.
        if age is not None and timedelta(0) <= age < INTERVAL:
            return None
        return self.if_changed("hourly")

    def if_changed(self, reason: str) -> Path | None:
        """Make a backup unless the newest one contains all operations."""
        if self._saved is None:
            self._saved = {}
            if newest := self.newest():
                with suppress(core.InputError):
                    self._saved = check_backup(newest)
        return self.make(reason) if self._heads() != self._saved else None

    def _copy(self, part: Path) -> None:
        before = self._heads()
        self._database.copy_to(part)
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        saved = check_backup(part)
        for site, (seq, _) in before.items():
            if saved.get(site, (0, ""))[0] < seq:
                raise OSError("the copy lacks operations")
        for site, (seq, digest) in saved.items():
            sql = "SELECT hash FROM op WHERE site = ? AND seq = ?"
            if self._database.first(sql, (site, seq)) != (digest,):
                raise OSError("the copy has other operations")
        self._saved = saved

    def _heads(self) -> Heads:
        with self._database.reading() as connection:
            return newest_operations(connection)


def restore_backup(dataset: Path, backup: Path) -> Path | None:
    """Replace the catalogue by ``backup``; return the new path of the old catalogue.

    The next opening replays the journal, so no label is lost. A dataset without a journal takes any
    backup. Raises ``InputError`` for a damaged backup, or one of another dataset, and
    ``DatasetInUseError`` if the dataset is open.
    """
    sites = check_backup(backup)
    journals = {path.stem for path in (dataset / "labels").glob("*.jsonl")}
    described = dataset / "dataset.json"
    own = described.read_text("utf-8", "replace") if described.is_file() else ""
    # A lost journal is no sign of another dataset.
    if sites and journals and not any(site in journals or site in own for site in sites):
        raise _bad(backup, "it is of another dataset")
    part = dataset / f".{CATALOGUE_FILE}.tmp"
    with closing(WriterLock.take(dataset)):
        with _disk_errors(dataset):
            shutil.copyfile(backup, part)
        return put_in_place(dataset, part)


def put_in_place(dataset: Path, part: Path) -> Path | None:
    """Make the complete file ``part`` the catalogue; return the new path of the old one, if any."""
    stamp = datetime.now(UTC).strftime(STAMP)
    old, aside = dataset / CATALOGUE_FILE, dataset / QUARANTINE / f"catalog-{stamp}.db"
    with _disk_errors(dataset):
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        kept = old.exists()
        core.make_folder(aside.parent)
        for suffix in ("-shm", "-wal", ""):
            # The WAL belongs to the old file; SQLite would replay it into the new one.
            place = dataset / f"{CATALOGUE_FILE}{suffix}"
            if place.exists():
                place.replace(aside.with_name(f"{aside.name}{suffix}"))
        part.replace(old)
        core.sync_folder(dataset)
    return aside if kept else None


def _bad(path: Path, why: str) -> core.InputError:
    return core.InputError(f"The backup is not usable: {why}.", str(path), "Use another backup.")


@contextmanager
def _disk_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, sqlite3.Error, core.InputError) as error:
        raise core.FaultError(
            core.Fault(
                "BACKUP-FAILED",
                f"The catalogue could not be copied: {error}.",
                "The catalogue itself is untouched; the newest backup is older than it should be.",
                f"Make room on the disk of {folder}, then make a backup.",
            )
        ) from error
