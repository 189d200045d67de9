"""Camera controls by the names of older and newer kernels, against the kernel's own layout."""

import errno
import struct

import pytest

from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.devices.cameras.sources import find_controls, lock_controls

NEWER = {
    "User Controls": None,
    "White Balance, Automatic": 1,
    "White Balance Temperature": 6500,
    "Camera Controls": None,
    "Auto Exposure": 3,
    "Exposure Time, Absolute": 100,
    "Exposure, Dynamic Framerate": 1,
}
OLDER = {
    "White Balance Temperature, Auto": 1,
    "White Balance Temperature": 6500,
    "Exposure, Auto": 3,
    "Exposure (Absolute)": 100,
    "Exposure, Auto Priority": 1,
}
LOCKED = {
    "white_balance_auto": 0.0,
    "exposure_auto": 1.0,
    "exposure_priority": 0.0,
    "exposure": 180.0,
    "white_balance": 4500.0,
}


class Kernel:
    """Answers as the kernel's video layer does; ``None`` marks the title of a class."""

    def __init__(self, controls, barred=()):
        self.titles = list(controls)
        self.values = dict(controls)
        self.barred = barred

    def __call__(self, file, request, content):
        (first,) = struct.unpack_from("<I", content)
        if request == 0xC0445624:  # _IOWR('V', 36, struct v4l2_queryctrl)
            assert len(content) == 68
            assert first & 0x80000000
            number = first & 0x7FFFFFFF
            if number >= len(self.titles):
                raise OSError(errno.EINVAL, "no more")
            title = self.titles[number]
            kind = 6 if self.values[title] is None else 1
            flags = 0x1 if title in self.barred else 0
            head = struct.pack("<II32s", number + 1, kind, title.encode())
            return head + struct.pack("<4iI2I", 0, 10_000, 1, 0, flags, 0, 0)
        assert len(content) == 8
        title = self.titles[first - 1]
        if request == 0xC008561C:  # _IOWR('V', 28, struct v4l2_control)
            autos = [v for t, v in self.values.items() if t in ("Auto Exposure", "Exposure, Auto")]
            if "Absolute" in title and autos not in ([], [1]):
                raise OSError(errno.EACCES, "the automatic is on")
            self.values[title] = struct.unpack("<Ii", content)[1]
            return content
        assert request == 0xC008561B  # _IOWR('V', 27, struct v4l2_control)
        return struct.pack("<Ii", first, self.values[title])


@pytest.mark.parametrize("titles", [NEWER, OLDER], ids=["newer kernel", "older kernel"])
def test_each_control_is_set_by_the_name_that_exists_and_read_back(titles, tmp_path):
    node, kernel = tmp_path / "video0", Kernel(titles)
    node.touch()
    assert lock_controls(node, GelsightSettings(), kernel) == LOCKED
    assert set(kernel.values.values()) - {None} == {0, 1, 180, 4500}


def test_a_lab_may_name_its_own_control_and_what_is_missing_is_left_out(tmp_path):
    node, kernel = tmp_path / "video0", Kernel({"Shutter": 7})
    node.touch()
    settings = GelsightSettings(control_names={"exposure": ("exposure_absolute", "shutter")})
    assert lock_controls(node, settings, kernel) == {"exposure": 180.0}


def test_what_the_camera_refuses_is_told_as_it_is(tmp_path):
    node, kernel = tmp_path / "video0", Kernel({"Auto Exposure": 3, "Exposure Time, Absolute": 100})
    node.touch()
    settings = GelsightSettings(control_names={"exposure": ("exposure_time_absolute",)})
    assert lock_controls(node, settings, kernel) == {"exposure": 100.0}


def test_a_control_that_is_switched_off_does_not_exist():
    assert find_controls(0, Kernel(NEWER, barred=("Auto Exposure",))).keys() == {
        "white_balance_automatic",
        "white_balance_temperature",
        "exposure_time_absolute",
        "exposure_dynamic_framerate",
    }


def test_what_is_no_camera_has_no_controls(tmp_path):
    plain = tmp_path / "file"
    plain.touch()
    assert lock_controls(plain, GelsightSettings()) == {}
    assert lock_controls(tmp_path / "nothing", GelsightSettings()) == {}
