from __future__ import annotations

import argparse
import io
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.backend.sensing.known_truth import (
    GELSIGHT,
    REST_FRAME,
    bump_field,
    rest_dots,
    true_places,
    warp,
)
from touchdown.backend.cli import track
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import TactileFrame
from touchdown.backend.sensing.picture_files import count_pictures, draw_markers, read_pictures
from touchdown.backend.sensing.tracker import MarkerTracker

CLIP = GELSIGHT / "blue_box_exp2_camera_2.avi"


def call(*words: str, as_json: bool = True) -> str:
    parser = argparse.ArgumentParser()
    track.add_arguments(parser)
    stream = io.StringIO()
    assert track.run(parser.parse_args(list(words)), VerbOutput(json=as_json, stream=stream)) == 0
    return stream.getvalue()


@pytest.fixture(scope="module")
def short_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 12 frames: the rest frame, then the bump field growing to 6 px."""
    folder = tmp_path_factory.mktemp("frames")
    image, _ = rest_dots()
    for k, a in enumerate(np.linspace(0, 6, 12)):
        cv2.imwrite(str(folder / f"{k}.png"), warp(image, bump_field, float(a)))
    return folder


def test_json_has_the_promised_shape_and_true_values(short_clip: Path) -> None:
    answer = json.loads(call(str(short_clip)))
    assert answer["grid"] == "7x9"
    frames = answer["frames"]
    assert [frame["index"] for frame in frames] == list(range(12))
    assert all(set(frame) == {"index", "ms", "quality", "markers"} for frame in frames)
    last = frames[-1]["markers"]
    keys = {"row", "col", "x_px", "y_px", "dx_px", "dy_px", "state"}
    assert all(set(marker) == keys for marker in last)
    assert [(m["row"], m["col"]) for m in last] == [(r, c) for r in range(7) for c in range(9)]
    assert {marker["state"] for marker in last} == {"seen"}
    _, dots = rest_dots()
    truth = true_places(dots, bump_field, 6.0) - dots
    moved = np.array([(marker["dx_px"], marker["dy_px"]) for marker in last])
    assert np.sqrt(((moved - truth) ** 2).sum(axis=1).mean()) < 0.06


def test_displacements_count_from_the_reference_file(short_clip: Path) -> None:
    one = call(str(short_clip / "11.png"), "--reference", str(REST_FRAME))
    moved = np.array([m["dx_px"] for m in json.loads(one)["frames"][0]["markers"]])
    _, dots = rest_dots()
    truth = (true_places(dots, bump_field, 6.0) - dots)[:, 0]
    assert np.abs(moved - truth).max() < 0.3


def test_overlay_and_table_for_people(short_clip: Path, tmp_path: Path) -> None:
    video = tmp_path / "drawn.mp4"
    text = call(str(short_clip), "--overlay", str(video), as_json=False)
    assert "100.00 %" in text
    assert count_pictures(video) == 12
    assert next(iter(read_pictures(video))).image.shape == (240, 320, 3)


def test_rings_are_drawn_around_the_dots() -> None:
    frame = next(read_pictures(REST_FRAME))
    field = MarkerTracker("left").track(frame)
    drawn = draw_markers(frame, field)
    assert drawn.shape == (720, 960, 3)
    u, v = np.rint(3 * (field.position_px[31] + 0.5)).astype(int)
    assert tuple(drawn[v, u + 27]) == pytest.approx((120, 230, 120), abs=40)


@pytest.mark.parametrize(
    "name", ["plug_3D_exp3_camera_0.avi", "artificial_strawberry_exp2_camera_2.avi"]
)
def test_a_small_dot_gel_is_refused_by_name(name: str) -> None:
    with pytest.raises(InputError) as refused:
        call(str(GELSIGHT / name))
    assert "8x10 small-dot gel recognised" in refused.value.what
    assert name in refused.value.where


def test_bad_input_names_the_file(tmp_path: Path) -> None:
    broken = tmp_path / "broken.png"
    broken.write_bytes(REST_FRAME.read_bytes()[:200])
    text = tmp_path / "words.avi"
    text.write_text("no video")
    square = tmp_path / "square.png"
    cv2.imwrite(str(square), np.zeros((300, 300, 3), np.uint8))
    empty = tmp_path / "empty"
    empty.mkdir()
    for path in (broken, text, square, empty, tmp_path / "missing.png"):
        with pytest.raises(InputError) as refused:
            call(str(path))
        assert refused.value.where == str(path)
    with pytest.raises(InputError, match="8x10"):
        call(str(REST_FRAME), "--grid", "8x10")
    with pytest.raises(InputError) as refused:
        call(str(REST_FRAME), "--overlay", str(tmp_path / "no" / "x.mp4"))
    assert "x.mp4" in refused.value.where


def test_a_folder_is_read_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        image = np.full((240, 320, 3), number, np.uint8)
        cv2.imwrite(str(tmp_path / f"f{number}.png"), image)
    shutil.copy(GELSIGHT / "README.md", tmp_path / "notes.md")
    frames = list(read_pictures(tmp_path))
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [1, 2, 10]
    assert [frame.t_s for frame in frames] == [0.0, 0.04, 0.08]


def test_a_clip_has_its_450_frames_at_its_own_rate() -> None:
    assert count_pictures(CLIP) == 450
    first, second, *_ = list(read_pictures(CLIP))
    assert second.t_s - first.t_s == pytest.approx(0.04)


def test_larger_pictures_are_scaled_to_the_same_places(tmp_path: Path) -> None:
    large = tmp_path / "large.png"
    image = cv2.imread(str(REST_FRAME))
    cv2.imwrite(str(large), cv2.resize(image, (1280, 960), interpolation=cv2.INTER_CUBIC))
    scaled = next(read_pictures(large))
    plain = TactileFrame("left", 0, 0.0, image)
    own, other = (MarkerTracker("left").track(f).position_px for f in (plain, scaled))
    assert np.abs(own - other).max() < 0.1
