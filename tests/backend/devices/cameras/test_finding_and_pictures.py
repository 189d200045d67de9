"""Which camera is which, what is cut, scaled and mirrored, and what a UVC camera is told."""

import random

import cv2
import numpy as np
import pytest

from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.cameras.frames import decode, fit_picture
from touchdown.backend.devices.cameras.sources import UvcSource
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.gelsight.driver import FoundCamera, TactileCamera, find_cameras
from touchdown.backend.devices.gelsight.emulator import encode


@pytest.fixture
def system(tmp_path):
    """A folder like the system's: two GelSights with two nodes each, and a webcam."""
    cards = [
        "GelSight Mini R0B 2D8Y-69GR: Ge",
        "Integrated Camera",
        "GelSight Mini R0B AAAA-1111: Ge",
    ]
    for number, (card, index) in enumerate((card, index) for card in cards for index in (0, 1)):
        entry = tmp_path / "names" / f"video{number + 8}"
        entry.mkdir(parents=True)
        (entry / "name").write_text(card + "\n")
        (entry / "index").write_text(f"{index}\n")
    (tmp_path / "nodes").mkdir()
    (tmp_path / "by-id").mkdir()
    return tmp_path


def found(system):
    return find_cameras(system / "by-id", system / "names", system / "nodes")


def test_cameras_are_found_by_their_number_and_the_picture_node(system):
    nodes = system / "nodes"
    assert found(system) == [
        FoundCamera("2D8Y-69GR", nodes / "video8"),
        FoundCamera("AAAA-1111", nodes / "video12"),
    ]


@pytest.mark.promise("C6")
def test_another_number_in_the_place_of_the_own_is_refused_100_times_of_100(system):
    places = {name: str(system / name.replace("_", "-")) for name in ("by_id", "names", "nodes")}
    content = {**places, "left": {"serial": "2D8Y-69GR"}, "right": {"serial": "AAAA-1111"}}
    driver = TactileCamera("left", GelsightSettings.model_validate(content), lambda: 0.0)
    assert driver.find() == system / "nodes" / "video8"
    draw = random.Random(1)
    for _ in range(100):
        other = "".join(draw.choices("ABCDEFGHJKLMNPQRSTUVWXYZ0123456789", k=8))
        card = f"GelSight Mini R0B {other[:4]}-{other[4:]}: Ge"
        (system / "names" / "video8" / "name").write_text(card + "\n")
        with pytest.raises(FaultError, match=f"'2D8Y-69GR'.*{other[:4]}-{other[4:]}"):
            driver.find()


def test_a_stable_link_goes_first_and_a_dangling_one_is_left_out(system):
    link = system / "by-id" / "usb-Arducam_GelSight_Mini_R0B_2D8Y-69GR:_Ge-video-index0"
    link.symlink_to(system / "nodes" / "video8")
    assert found(system)[0].path == system / "nodes" / "video8"
    (system / "nodes" / "video8").touch()
    assert found(system)[0].path == link


def test_without_any_folder_there_is_no_camera(tmp_path):
    assert find_cameras(tmp_path / "a", tmp_path / "b", tmp_path / "c") == []


def ramp(width, height):
    """Blue rises to the right and green downward: every place has its colour."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[..., 0] = np.linspace(0, 250, width)[None, :]
    picture[..., 1] = np.linspace(0, 250, height)[:, None]
    return picture


def test_a_native_picture_is_decoded_reduced_cut_and_scaled():
    content = encode(ramp(3280, 2464))
    rough = decode(content, 0.15)
    assert rough.shape == (616, 820, 3)
    picture = fit_picture(rough, 0.15, "none")
    assert picture.shape == (240, 320, 3)
    corners = picture[0, 0, :2].astype(int), picture[-1, -1, :2].astype(int)
    assert np.abs(corners[0] - 0.15 * 250).max() < 2
    assert np.abs(corners[1] - 0.85 * 250).max() < 2


@pytest.mark.parametrize(
    ("mirror", "corner"), [("none", (0, 0)), ("x", (250, 0)), ("y", (0, 250)), ("both", (250, 250))]
)
def test_mirroring_turns_the_picture_over(mirror, corner):
    assert tuple(fit_picture(ramp(320, 240), 0.0, mirror)[0, 0, :2]) == corner


def test_what_is_not_four_to_three_or_damaged_is_refused():
    with pytest.raises(ProtocolError, match="shape"):
        fit_picture(ramp(320, 320), 0.0, "none")
    with pytest.raises(ProtocolError):
        decode(encode(ramp(320, 240))[:80], 0.0)


class Capture:
    """Stands in for OpenCV's: notes what is set, returns what the test wants."""

    def __init__(self, *opened):
        self.opened, self.set_to, self.answers = opened, [], []

    def isOpened(self):  # noqa: N802
        return True

    def set(self, number, value):
        self.set_to.append((number, value))
        return True

    def get(self, number):
        return dict(self.set_to).get(number, 25.0)

    def read(self):
        return self.answers.pop(0)

    def release(self):
        pass


def test_a_uvc_camera_is_set_to_raw_jpeg_before_its_size_and_locked(tmp_path):
    made = []
    source = UvcSource(
        tmp_path / "video8",
        GelsightSettings(),
        lambda *words: made.append(Capture(*words)) or made[0],
    )
    numbers = [number for number, _ in made[0].set_to]
    assert numbers.index(cv2.CAP_PROP_FOURCC) < numbers.index(cv2.CAP_PROP_FRAME_WIDTH)
    told = dict(made[0].set_to)
    assert told[cv2.CAP_PROP_AUTO_EXPOSURE] == 1.0
    assert told[cv2.CAP_PROP_AUTO_WB] == 0.0
    assert source.facts["exposure"] == 180.0
    content = encode(ramp(320, 240))
    raw = np.frombuffer(content, np.uint8)[None, :]
    made[0].answers = [(True, raw), (False, None), (True, np.empty((0, 0), np.uint8))]
    assert source.read(0.1) == content
    assert source.read(0.1) is None
    assert source.read(0.1) is None
