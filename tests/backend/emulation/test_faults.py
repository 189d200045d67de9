"""A fault plan: read and refused by name, on when it says, and exactly repeatable."""

import re
import shutil
import sys

import pytest

from tests.backend.devices.waiting import until
from touchdown.backend.core.faults import InputError
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.gelsight import GelsightServer, find_cameras
from touchdown.backend.emulation.fault_plan import FaultPlan, Faults, PlannedFault, load_faults

MESSAGES = [b"abcdefgh", b"ijklmnop"]


def faults(kind, **more):
    plan = FaultPlan(fault=(PlannedFault(at_s=1.0, device="force_torque", kind=kind, **more),))
    made = Faults("force_torque", plan)
    made.begin(100.0)
    return made


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ('device = "gripper"\nkind = "flip"', "fault.0.at_s"),
        ('at_s = -1\ndevice = "gripper"\nkind = "flip"', "fault.0.at_s"),
        ('at_s = 1\ndevice = "griper"\nkind = "flip"', "no device 'griper'"),
        ('at_s = 1\ndevice = "gripper"\nkind = "dark"', "'gripper' has no fault 'dark'"),
        ('at_s = 1\ndevice = "gripper"\nkind = "flip"\nshare = 2', "fault.0.share"),
        ('at_s = 1\ndevice = "gripper"\nkind = "flip"\nfor = 2', "fault.0.for"),
        ('at_s = 1\ndevice = "force_torque"\nkind = "slow"', "'hz', how many samples a second"),
        ('at_s = 1\ndevice = "gripper"\nkind = "flip"\nhz = 2', "'hz', how many samples a second"),
        ('at_s = 1\ndevice = "force_torque"\nkind = "drift"', "'n_per_s', by how many N a second"),
    ],
)
def test_a_bad_entry_is_one_error_that_names_it(tmp_path, entry, said):
    file = tmp_path / "plan.toml"
    file.write_text(f"[[fault]]\n{entry}\n")
    with pytest.raises(InputError, match=re.escape(said)) as raised:
        load_faults(file)
    assert raised.value.where == str(file)


def test_a_plan_is_read_for_its_device_only(tmp_path):
    file = tmp_path / "plan.toml"
    file.write_text(
        'seed = 3\n[[fault]]\nat_s = 1\ndevice = "gripper"\nkind = "part_lost"\n'
        '[[fault]]\nat_s = 2\ndevice = "force_torque"\nkind = "freeze"\nfor_s = 0.5\n'
    )
    plan = load_faults(file)
    sensor = Faults("force_torque", plan)
    sensor.begin(10.0)
    assert [sensor.names(t) for t in (11.5, 12.0, 12.49, 12.5)] == [
        (),
        ("freeze",),
        ("freeze",),
        (),
    ]


def test_nothing_goes_wrong_before_and_after():
    flaw = faults("silent", for_s=0.5)
    assert flaw.outgoing(100.9, MESSAGES) == MESSAGES
    assert flaw.outgoing(101.2, MESSAGES) == []
    assert flaw.outgoing(101.5, MESSAGES) == MESSAGES


def test_a_flip_changes_one_bit_of_each():
    spoilt = faults("flip").outgoing(101.0, MESSAGES)
    for before, after in zip(MESSAGES, spoilt, strict=True):
        assert len(before) == len(after)
        wrong = int.from_bytes(before, "big") ^ int.from_bytes(after, "big")
        assert wrong.bit_count() == 1


def test_a_share_strikes_that_share_and_the_same_ones_again():
    def kept():
        flaw = faults("lost", share=0.25)
        return [len(flaw.outgoing(101.0 + 0.001 * k, [b"x"])) for k in range(2000)]

    assert kept() == kept()
    assert sum(kept()) == pytest.approx(1500, abs=80)


def test_late_messages_come_later_and_none_is_lost():
    flaw = faults("late", for_s=0.05, by_s=0.2)
    assert flaw.outgoing(101.0, MESSAGES) == []
    assert flaw.outgoing(101.1, [b"new"]) == [b"new"]
    assert flaw.outgoing(101.2, [b"newer"]) == [*MESSAGES, b"newer"]


def test_doubled_cut_reordered_and_garbled():
    assert faults("duplicate").outgoing(101.0, [b"a"]) == [b"a", b"a"]
    assert faults("reorder").outgoing(101.0, MESSAGES) == MESSAGES[::-1]
    (cut,) = faults("cut").outgoing(101.0, MESSAGES[:1])
    assert MESSAGES[0].startswith(cut)
    assert len(cut) < len(MESSAGES[0])
    (noisy,) = faults("garbage").outgoing(101.0, MESSAGES[:1])
    assert noisy.endswith(MESSAGES[0])
    assert len(noisy) > len(MESSAGES[0])


def test_a_live_fault_begins_now_and_all_can_be_cleared():
    flaw = Faults("gripper")
    flaw.begin(5.0)
    flaw.inject(6.0, "fast_stop", 1.0)
    assert flaw.active("fast_stop", 6.5)
    assert not flaw.active("fast_stop", 7.1)
    flaw.inject(8.0, "unplug")
    flaw.clear()
    assert flaw.names(9.0) == ()


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


def test_a_file_is_not_replaced_by_the_name_of_a_port(tmp_path):
    from touchdown.backend.emulation.server import PtyServer

    file = tmp_path / "wrist.csv"
    file.write_text("mine")
    with pytest.raises(FileExistsError):
        PtyServer(EmulatedDynpick(lambda now_s: (0.0,) * 6), link=file)
    assert file.read_text() == "mine"


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
        # The nodes vanish one after the other.
        left = {"video2", "video3"}
        until(lambda: {node.name for node in (tmp_path / "nodes").iterdir()} == left)
        fronts[0].faults.clear()
        until(lambda: len(find_cameras(*places)) == 2)
        # Without stable links the numbers in the names tell the first node from the second.
        shutil.rmtree(tmp_path / "by-id")
        assert [camera.path.name for camera in find_cameras(*places)] == ["video2", "video4"]
    finally:
        for front in fronts:
            front.close()
    assert not any((tmp_path / "nodes").iterdir())
