"""A terminal, or a camera, put back after somebody removed the folder that it was in."""

import shutil
import sys

import pytest

from tests.backend.devices.waiting import until
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.gelsight.driver import find_cameras
from touchdown.backend.devices.gelsight.emulator import GelsightServer
from touchdown.backend.emulation.fault_plan import Faults

SERIALS = ("2D8Y-69GR", "28AB-70XY")


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
def test_it_serves_on_without_a_name(tmp_path):
    from touchdown.backend.emulation.server import PtyServer

    folder = tmp_path / "ports"
    folder.mkdir()
    faults = Faults("force_torque")
    sensor = EmulatedDynpick(lambda now_s: (0.0,) * 6)
    front = PtyServer(sensor, faults=faults, link=folder / "wrist")
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
    from touchdown.backend.emulation.server import PtyServer

    with pytest.raises(FileNotFoundError):
        PtyServer(EmulatedDynpick(lambda now_s: (0.0,) * 6), link=tmp_path / "nowhere" / "wrist")


def test_a_camera_whose_folder_is_gone_ends_quietly(tmp_path):
    folder = tmp_path / "cameras"
    front = GelsightServer(lambda now_s: None, folder)
    front.start()
    try:
        front.inject("unplug")
        until(lambda: not any((folder / "nodes").iterdir()))
        shutil.rmtree(folder)
        front.faults.clear()
        until(lambda: not front._thread.is_alive())
    finally:
        front.close()


def test_a_camera_has_two_nodes_of_which_the_first_is_found(tmp_path):
    places = [tmp_path / name for name in ("by-id", "names", "nodes")]
    fronts = [GelsightServer(lambda now_s: None, tmp_path, serial) for serial in SERIALS]
    try:
        nodes = {f"video{number}" for number in range(4)}
        assert {node.name for node in (tmp_path / "nodes").iterdir()} == nodes
        found = find_cameras(*places)
        assert [camera.path.resolve().name for camera in found] == ["video2", "video0"]
        fronts[0].start()
        fronts[0].inject("unplug")
        until(lambda: len(find_cameras(*places)) == 1)
        assert {node.name for node in (tmp_path / "nodes").iterdir()} == {"video2", "video3"}
        fronts[0].faults.clear()
        until(lambda: len(find_cameras(*places)) == 2)
        # Without stable links the numbers in the names tell the first node from the second.
        shutil.rmtree(tmp_path / "by-id")
        assert [camera.path.name for camera in find_cameras(*places)] == ["video2", "video4"]
    finally:
        for front in fronts:
            front.close()
    assert not any((tmp_path / "nodes").iterdir())
