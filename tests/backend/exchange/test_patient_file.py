"""HDF5 on a full disk: closes, can be read back, and reports the cause."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.exchange.robomimic import DiskFullSafeFile

h5py = pytest.importorskip("h5py")
FULL = Path("/dev/full")
VALUES = np.random.default_rng(1).normal(size=(40, 300, 20))


def fill(disk: DiskFullSafeFile) -> None:
    """Write more than the caches of HDF5 hold, and look at it before it is closed."""
    with h5py.File(disk, "w") as file:
        for k, values in enumerate(VALUES):
            file.create_dataset(f"demo_{k}/obs", data=values, compression=1)
            file[f"demo_{k}"].attrs["name"] = "x" * 5000
        for k, values in enumerate(VALUES):
            np.testing.assert_array_equal(file[f"demo_{k}/obs"][...], values)


@pytest.mark.skipif(not FULL.exists(), reason="the system has no /dev/full")
def test_a_full_disk_is_told_after_hdf5_has_closed() -> None:
    with DiskFullSafeFile(FULL) as disk:
        fill(disk)
        with pytest.raises(OSError, match="No space left") as caught:
            disk.check()
    assert caught.value.errno == errno.ENOSPC


def test_with_room_it_is_a_file_like_any_other(tmp_path: Path) -> None:
    with DiskFullSafeFile(tmp_path / "a.hdf5") as disk:
        fill(disk)
        disk.check()
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert len(file) == len(VALUES)
        np.testing.assert_array_equal(file["demo_7/obs"][...], VALUES[7])
