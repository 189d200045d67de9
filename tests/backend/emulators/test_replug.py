"""A pseudo terminal that is pulled and put back after somebody removed the folder of its name."""

import shutil
import sys

import pytest

from backend.emulators.dynpick import EmulatedDynpick
from backend.emulators.faults import Faults
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
