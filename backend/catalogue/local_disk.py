"""Which file systems can hold a dataset.

SQLite's WAL needs shared memory between processes: a network file system would corrupt it. One of
the FAT family keeps no log of its own: a crash of the program loses nothing there, a power cut may.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import psutil  # type: ignore[import-untyped]

from backend.core.faults import InputError

_NETWORK = """
nfs nfs3 nfs4 cifs smb smb2 smb3 smbfs sshfs fuse.sshfs ncpfs afs afpfs webdav davfs fuse.davfs2
fuse.rclone fuse.s3fs glusterfs fuse.glusterfs ceph lustre gpfs beegfs 9p
"""
NETWORK = frozenset(_NETWORK.split())
FAT = frozenset({"vfat", "msdos", "exfat", "fat", "fat32", "fuse.exfat"})

Mounts = Sequence[tuple[str, str]]
"""(mount point, type of file system)."""


def refuse_network(folder: Path, mounts: Mounts | None = None) -> None:
    """Raise ``InputError`` if ``folder`` lies on a network file system (NFS, SMB, sshfs ...)."""
    kind = file_system(folder.resolve(), _mounts() if mounts is None else mounts)
    if kind.lower() in NETWORK:
        raise InputError(
            f"The dataset lies on a network file system ({kind}), where its catalogue can break.",
            str(folder),
            "Keep the dataset on a local disk; copy or merge it afterwards.",
        )


def weakness(folder: Path, mounts: Mounts | None = None) -> str:
    """Return what the disk of ``folder`` does not promise, in words; "" where it promises all."""
    kind = file_system(folder.resolve(), _mounts() if mounts is None else mounts)
    if kind.lower() not in FAT:
        return ""
    return (
        f"The dataset lies on a {kind} disk, which a power cut can damage: what was recorded is "
        "safe from a crash of the program only. Keep the dataset on a disk with a journal (ext4, "
        "NTFS, APFS) and only copies of it here."
    )


def file_system(folder: Path, mounts: Mounts) -> str:
    """Return the type of the file system that holds ``folder`` ("" if unknown)."""
    holding = [(len(Path(at).parts), kind) for at, kind in mounts if folder.is_relative_to(at)]
    return max(holding, default=(0, ""))[1]


def _mounts() -> Mounts:
    return [(part.mountpoint, part.fstype) for part in psutil.disk_partitions(all=True)]
