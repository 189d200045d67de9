"""A terminal, or a camera, put back after somebody removed the folder that it was in."""

import shutil
import sys

import pytest

from backend.emulators.dynpick import EmulatedDynpick
from backend.emulators.faults import Faults
from backend.emulators.gelsight import GelsightFront
from tests.backend.devices.waiting import until


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
def test_it_serves_on_without_a_name(tmp_path):
    from backend.emulators.front import PtyFront

    folder = tmp_path / "ports"
    folder.mkdir()
    faults = Faults("force_torque")
    sensor = EmulatedDynpick(lambda now_s: (0.0,) * 6)
    front = PtyFront(sensor, faults=faults, link=folder / "wrist")
    front.start()
    try:
        assert (folder / "wrist").is_symlink()
        front.inject("unplug")
        until(lambda: not (folder / "wrist").is_symlink())
        shutil.rmtree(folder)
        front.faults.clear()
        until(lambda: front.plugs == 2)
        assert front._thread.is_alive()
    finally:
        front.close()


def test_a_folder_that_never_was_is_refused_at_the_start(tmp_path):
    from backend.emulators.front import PtyFront

    with pytest.raises(FileNotFoundError):
        PtyFront(EmulatedDynpick(lambda now_s: (0.0,) * 6), link=tmp_path / "nowhere" / "wrist")


def test_a_camera_whose_folder_is_gone_ends_quietly(tmp_path):
    folder = tmp_path / "cameras"
    front = GelsightFront(lambda now_s: None, folder)
    front.start()
    try:
        front.inject("unplug")
        until(lambda: not any((folder / "nodes").iterdir()))
        shutil.rmtree(folder)
        front.faults.clear()
        until(lambda: not front._thread.is_alive())
    finally:
        front.close()
