"""Requirements on the folder of a dataset: local file system, free space, single writer.

The writer locks a file that contains its name; the operating system frees the lock when the process
ends.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

import psutil

from touchdown.backend.core import InputError, account_name, lock_file, make_folder, parse_json

# error numbers of a full disk or an exhausted quota
DISK_FULL_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
LEAST_BYTES = 1_000_000_000
# A run in progress pauses below this, since catalogue and journals still need space.
LEAST_BYTES_RUNNING = 500_000_000


def check_free_space(folder: Path) -> None:
    """Raise ``InputError`` if the disk has less than 1 GB free."""
    place, free = _free(folder)
    if free < LEAST_BYTES:
        raise InputError(
            f"Only {free / 1e9:.2f} GB are free;"
            f" recording needs {LEAST_BYTES / 1e9:.2f} GB to start.",
            str(place),
            "Free some space, or record on another disk.",
        )


def free_bytes_if_low(folder: Path) -> int | None:
    """Return the free bytes if they are too few for another episode, else None."""
    _, free = _free(folder)
    return free if free < LEAST_BYTES_RUNNING else None


def _free(folder: Path) -> tuple[Path, int]:
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    return place, shutil.disk_usage(place).free


_NETWORK = """
nfs nfs3 nfs4 cifs smb smb2 smb3 smbfs sshfs fuse.sshfs ncpfs afs afpfs webdav davfs fuse.davfs2
fuse.rclone fuse.s3fs glusterfs fuse.glusterfs ceph lustre gpfs beegfs 9p
"""
NETWORK = frozenset(_NETWORK.split())
FAT = ("vfat", "msdos", "exfat", "fat", "fat32", "fuse.exfat")

Mounts = Sequence[tuple[str, str]]  # (mount point, type of file system)


def check_local_disk(folder: Path, mounts: Mounts | None = None) -> None:
    """Raise ``InputError`` if ``folder`` lies on a network file system (NFS, SMB, sshfs ...)."""
    kind = file_system(folder, mounts)
    if kind.lower() in NETWORK:
        what = f"The dataset lies on a network file system ({kind}), where its catalogue can break."
        fix = "Keep the dataset on a local disk; copy or merge it afterwards."
        raise InputError(what, str(folder), fix)


def disk_weakness(folder: Path, mounts: Mounts | None = None) -> str:
    """Return a warning if the disk of ``folder`` is not safe against power loss, else ""."""
    kind = file_system(folder, mounts)
    if kind.lower() not in FAT:
        return ""
    return (
        f"The dataset lies on a {kind} disk, which a power cut can damage: what was recorded is "
        "safe from a crash of the program only. Keep the dataset on a disk with a journal (ext4, "
        "NTFS, APFS) and only copies of it here."
    )


def file_system(folder: Path, mounts: Mounts | None = None) -> str:
    """Return the type of the file system that holds ``folder`` ("" if unknown)."""
    place = folder.resolve()
    if mounts is None:
        mounts = [(part.mountpoint, part.fstype) for part in psutil.disk_partitions(all=True)]
    holding = [(len(Path(at).parts), kind) for at, kind in mounts if place.is_relative_to(at)]
    return max(holding, default=(0, ""))[1]


LOCK_NAME = "writer.lock"


@dataclass(frozen=True, slots=True)
class WriterInfo:
    """Writer of a dataset: person, process, computer and start (UTC)."""

    person: str
    pid: int
    host: str
    since: str

    def __str__(self) -> str:
        return f"{self.person} (process {self.pid} on {self.host}, since {self.since})"


class NotWritableError(InputError):
    """The dataset can be opened for reading only."""


class ReadOnlyFolderError(NotWritableError):
    """The folder of the dataset cannot be written."""

    def __init__(self, folder: Path, error: OSError) -> None:
        super().__init__(
            f"The dataset cannot be written: {error.strerror or error}.",
            str(folder),
            "Make its folder and disk writable, or copy it to a disk that is; looking, verifying "
            "and exporting do without.",
        )


class DatasetInUseError(NotWritableError):
    """Another process (or another part of this one) writes the dataset; see ``holder``."""

    def __init__(self, folder: Path, holder: WriterInfo | None) -> None:
        who = "another program" if holder is None else str(holder)
        super().__init__(
            f"The dataset is being written by {who}.",
            str(folder),
            "Close it there first; until then the dataset can be read.",
        )
        self.holder = holder


class WriterLock:
    """Lock for writing a dataset, from ``take`` until ``close``."""

    def __init__(self, folder: Path, descriptor: int) -> None:
        self._path, self._descriptor = folder / LOCK_NAME, descriptor

    @classmethod
    def take(cls, folder: Path, person: str = "") -> Self:
        """Lock ``folder`` for ``person``.

        Raises ``DatasetInUseError`` with the holder, or ``ReadOnlyFolderError``.
        """
        try:
            make_folder(folder)
            descriptor = lock_file(folder / LOCK_NAME)
        except BlockingIOError:
            raise DatasetInUseError(folder, lock_holder(folder)) from None
        except OSError as error:
            raise ReadOnlyFolderError(folder, error) from error
        now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
        writer = person or account_name() or "someone"
        me = WriterInfo(writer, os.getpid(), socket.gethostname(), now)
        with suppress(OSError):  # a full disk: the lock holds without the name
            os.ftruncate(descriptor, 0)
            os.write(descriptor, json.dumps(asdict(me)).encode("utf-8"))
        return cls(folder, descriptor)

    def close(self) -> None:
        """Release the lock. The file stays: removing it would let two writers in."""
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)


def lock_holder(folder: Path) -> WriterInfo | None:
    """Return the last writer, or None if the file does not name one."""
    try:
        return WriterInfo(**parse_json((folder / LOCK_NAME).read_text("utf-8")))
    except (OSError, ValueError, TypeError):
        return None
