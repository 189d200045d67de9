"""SQLite's WAL needs shared memory between processes: a network file system would corrupt it."""

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


def file_system(folder: Path, mounts: Mounts) -> str:
    """Return the type of the file system that holds ``folder`` ("" if unknown)."""
    holding = [(len(Path(at).parts), kind) for at, kind in mounts if folder.is_relative_to(at)]
    return max(holding, default=(0, ""))[1]


def _mounts() -> Mounts:
    return [(part.mountpoint, part.fstype) for part in psutil.disk_partitions(all=True)]
