"""Recordings of other laboratories: mapping file, presses, contradictions, preview."""

from __future__ import annotations

import json
import re
import shutil
import threading
import tomllib
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap_ros2.writer import Writer

from touchdown.backend.annotations import Dataset
from touchdown.backend.cli.command_line import main
from touchdown.backend.config import read_settings
from touchdown.backend.core import FINGERS, InputError
from touchdown.backend.exchange import mapping
from touchdown.backend.exchange.features import ForeignEpisode, RecordedSignal
from touchdown.backend.exchange.imports import read_foreign, recording_contents
from touchdown.backend.exchange.mapped_presses import (
    contradictions,
    cut_press,
    find_presses,
    measure_press,
)
from touchdown.backend.exchange.mapping import ImportMapping, propose_mapping, recording_format
from touchdown.backend.geometry import load_pieces
from touchdown.backend.identification.recordings import (
    Delays,
    read_recordings,
    refuse_unusable,
    sample_presses,
)
from touchdown.backend.identification.stages import split_grips

FOREIGN = Path(__file__).parents[2] / "data/foreign"  # .ci/exchange_check/foreign_example.py
MAP = FOREIGN / "map.toml"
ARRAY = {"source": "/gel_left/compressed", "kind": "displacements", "turn_deg": 180}


@pytest.fixture(scope="module")
def bag() -> dict[str, list[tuple[int, Any]]]:
    """The messages by topic. The left gel is an array of displacements, tracked beforehand."""
    signals = read_settings(ImportMapping, MAP)
    topics = {signal.source: list(mapping.read_messages([FOREIGN / "press.mcap"], signal))
              for signal in signals.sources.values()}  # fmt: skip
    (episode,) = mapping.read("mcap", FOREIGN / "press.mcap", MAP)
    upright = episode.values["left"] - episode.values["left"][0]
    films = topics["/gel_left/compressed"]
    topics["/gel_left/compressed"] = [
        (stamp, -field[::-1].ravel()) for (stamp, _), field in zip(films, upright, strict=True)
    ]
    return topics


def mapped(bag: Any, **changes: dict[str, Any]) -> tuple[ImportMapping, list[ForeignEpisode]]:
    content = read_settings(ImportMapping, MAP).model_dump() | {"left": ARRAY}
    content = {name: {**signal, **changes.get(name, {})} for name, signal in content.items()}
    signals = ImportMapping.model_validate(content)
    values = mapping.map_signals(
        signals, {name: bag[one.source] for name, one in signals.sources.items()}
    )
    episode = ForeignEpisode(0, None, values)
    presses = [cut_press(episode, k, t_s, signals) for k, t_s in enumerate(find_presses(values))]
    return signals, presses


def test_a_recording_of_another_laboratory_has_the_numbers_of_the_bench(bag):
    signals, (press,) = mapped(bag)
    assert contradictions([measure_press(press)], signals) == []
    assert press.quality.accepted
    with np.load(FOREIGN / "truth.npz") as truth:
        markers = press.values["observation.markers"] - truth["observation"][:, :252]
        wrench = press.values["observation.ft"] - truth["observation"][:, 252:]
        np.testing.assert_allclose(press.values["label.offset_mm"], truth["offset_mm"], atol=0.02)
    assert np.sqrt((markers**2).mean()) < 0.2
    # The offset after the tare differs; the press has 7.8 N and 0.11 N m.
    assert np.abs(wrench[:, :3]).max() < 0.3
    assert np.abs(wrench[:, 3:]).max() < 0.02


# Their cause does not follow from the signals.
NO_PROPOSAL = ("No press was found", "'right' move by 3.8e+02 px", "The face lies 420 mm off",
               "'right' has no samples at the presses", "The gels turn against")  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"wrench": {"acts_on": "tool"}}, "Fz falls by 7.5 N while the arm goes down"),
        ({"wrench": {"axes": ("z", "x", "y")}}, "changes most along x while pressed"),
        ({"wrench": {"force_unit": "mN"}}, "No press was found"),
        ({"wrench": {"force_unit": "kgf"}}, "the payload weighs -14.7 N"),
        ({"wrench": {"moment_unit": "N m"}}, 'Try moment_unit = "N mm" in [wrench].'),
        ({"pose": {"unit": "mm"}}, "'unit' of 'pose'"),
        ({"pose": {"origin_mm": (0.412, -0.035)}}, "The face lies 420 mm off the bottom"),
        ({"pose": {"axes": ("x", "-y", "-z")}}, "The arm goes up"),
        ({"pose": {"axes": ("-z", "y", "x")}}, "The arm travels along x"),
        ({"pose": {"axes": ("y", "z", "x")}}, "The arm travels along y"),
        ({"left": {"turn_deg": 0}}, "not up: its 'turn_deg'. Try turn_deg = 180 in [left]."),
        ({"right": {"width_px": 9.0}}, "'right' move by 3.8e+02 px"),
        ({"right": {"time_offset_s": 0.2}}, "0.16 s after the force: its 'time_offset_s'. Try "),
        ({"right": {"time_offset_s": 60.0}}, "'right' has no samples at the presses"),
        ({"left": {"mirror": True}, "right": {"mirror": True}}, "The gels turn against"),
    ],
)
def test_a_wrong_unit_or_frame_is_named_by_what_contradicts_it(bag, changes, named):
    signals, presses = mapped(bag, **changes)
    found = contradictions([measure_press(press) for press in presses], signals)
    assert any(named in str(one) for one in found), found
    if not any(one.changes for one in found):
        assert named.startswith(NO_PROPOSAL)
        return
    for signal, field, value in (change for one in found for change in one.changes):
        changes = {**changes, signal: {**changes.get(signal, {}), field: value}}
    signals, presses = mapped(bag, **changes)
    left = contradictions([measure_press(press) for press in presses], signals)
    # Axes that turn z alone may exchange x and y: only a label can tell.
    assert all("'origin_mm', in mm, or 'axes' of 'pose'" in one.text for one in left)
    assert not left or "travels along" in named


def test_proposed_values_are_set_in_the_file_and_all_else_stays():
    text = (
        "# of Ann\n[wrench]  # the sensor\nsource = '/a'  # six\naxes = ['x', \"y\", 'z']  # up\n"
        '[left]\nsource = "[x]"\nturn_deg = 90# quarter\n'
    )
    changes = [
        ("wrench", "axes", ["x", "-y", "-z"]),
        ("left", "turn_deg", 270),
        ("left", "mirror", True),
        ("pose", "unit", "m"),
        ("wrench", "source", "/d"),
    ]
    assert mapping.correct_mapping(text, changes) == (
        '# of Ann\n[wrench]  # the sensor\nsource = "/d"  # six\naxes = ["x", "-y", "-z"]  # up\n'
        '[left]\nmirror = true\nsource = "[x]"\nturn_deg = 270# quarter\n'
    )


def test_markers_that_stand_still_are_named_without_a_warning(bag):
    still = [(stamp, bag["/gel_right/markers"][0][1]) for stamp, _ in bag["/gel_right/markers"]]
    signals, (press,) = mapped({**bag, "/gel_right/markers": still})
    (found,) = contradictions([measure_press(press)], signals)
    assert "The markers of 'right' move by" in str(found)


@pytest.mark.parametrize("turn_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", [False, True])
def test_markers_turn_like_the_picture_they_are_in(turn_deg, mirror):
    """One marker of a picture goes 5 px to the right and 1 px down."""
    shape = (9, 7) if turn_deg in (90, 270) else (7, 9)
    content = read_settings(ImportMapping, MAP).model_dump()["right"] | {
        "kind": "displacements", "turn_deg": turn_deg, "mirror": mirror, "order": "planes"
    }  # fmt: skip
    whole = read_settings(ImportMapping, MAP).model_dump() | {"right": content}
    source = ImportMapping.model_validate(whole).right
    before, after = np.zeros((*shape, 2), int), np.zeros((*shape, 2))
    before[2, 3], after[2, 3] = 1, (5.0, 1.0)
    picture = np.zeros((10 * shape[0], 10 * shape[1]))
    picture[25, 35], picture[26, 40] = 1.0, 2.0
    turned = source.turned(picture)
    (v0,), (u0,) = np.nonzero(turned == 1.0)
    (v1,), (u1,) = np.nonzero(turned == 2.0)
    still, moved = source.converted([np.moveaxis(field, 2, 0) for field in (0.0 * after, after)])
    marker = 9 * (v0 // 10) + u0 // 10
    np.testing.assert_allclose((moved - still)[marker], (u1 - u0, v1 - v0), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ('unit = "m"', 'unit = "inch"', "pose.unit"),
        ("payload_kg", "payload_g", "payload_g"),
        ('"-y", "-z"]', '"y", "-z"]', "right-handed"),
        ("/tool_pose", "/tool", "There are 0 messages or rows of '/tool'"),
        ('source = "/tool_pose"', 'source = "/tool_pose"\nfirst = 6', "has 7 numbers"),
        ('kind = "positions"', 'kind = "images"', "It has numbers only"),
        ('stamp = "log"', '[grips]\ngrip = "recordings"', "0 messages or rows of 'recordings'"),
        ('stamp = "log"', "[grips]\ngrip = 1", "grips.grip"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused(tmp_path, old, new, named):
    path = tmp_path / "map.toml"
    path.write_text(MAP.read_text("utf-8").replace(old, new), "utf-8")
    with pytest.raises(InputError) as refused:
        list(mapping.read("mcap", FOREIGN / "press.mcap", path))
    assert named in refused.value.what


def test_the_command_draws_refuses_and_imports(tmp_path, capsys):
    words = ["import", "mcap", str(FOREIGN / "press.mcap"), "--dataset", str(tmp_path / "ds"),
             "--piece", "pot", "--bottom", "square15", "--map"]  # fmt: skip
    bad = tmp_path / "bad.toml"
    bad.write_text(MAP.read_text("utf-8").replace("environment", "tool"), "utf-8")
    page = tmp_path / "out.html"
    assert main([*words, str(bad), "--preview", str(page)]) == 1
    assert "sign ('acts_on') or frame ('axes') of 'wrench'" in capsys.readouterr().out
    assert "Fz falls by 7.5 N while the arm goes down" in page.read_text("utf-8")
    assert main([*words, str(MAP), "--check"]) == 0
    bad.write_text("wrench = 1", "utf-8")
    assert main([*words, str(bad)]) == main([*words, str(MAP), "--piece", "cup"]) == 2
    capsys.readouterr()
    assert main([*words, str(MAP), "--piece", "short"]) == 2
    assert "'short' cannot be grasped" in capsys.readouterr().err
    assert not (tmp_path / "ds").exists(), "no empty dataset is left"
    assert main([*words, str(MAP), "--preview", str(page)]) == 0
    drawn = page.read_text("utf-8")
    assert "<p>None.</p>" in drawn
    for title, ends in (
        ("Force", r"8\.2 N"),
        ("Hand from contact", r"0\.592 mm"),
        ("Markers, left", "px"),
    ):
        assert re.search(f'aria-label="{title}".*?{ends}</text></svg>', drawn), title
    with Dataset.open(tmp_path / "ds", write=False) as dataset:
        (entry,) = dataset.episodes()
        label = dataset.labels.head(entry.uuid).label
        recording = dataset.read(entry.uuid).recording
    assert label.offset_mm == pytest.approx([8.537, 1.931], abs=0.01)
    assert (len(recording.fields), entry.mode) == (118, "imported")
    capsys.readouterr()
    assert main([*words, str(MAP)]) == 0
    assert "Episodes found: 1, present already: 1." in (again := capsys.readouterr().out)
    assert "another pair" not in again
    assert main([*words, str(MAP), "--bottom", "circle15"]) == 0
    assert "here as pot on square15; another pair needs another" in capsys.readouterr().out
    assert main([*words[:-1]]) == 2
    assert "A name that is no file yet gets a mapping" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("mirrored", "named"),
    [([], []), (["left"], ["'left'"]), (["right"], ["'right'"]), (FINGERS, ["The gels"])],
)
def test_a_mirrored_gel_is_told_by_its_turn_over_several_presses(bag, mirrored, named):
    """The shift turns both pictures alike, by more than the moments of most presses do."""
    signals, (press,) = mapped(bag)
    rng, presses, own = np.random.default_rng(3), [], measure_press(press)
    for moment in (-0.07, 0.15, 0.07, -0.14, 0.10, -0.06, 0.18):
        turn = 0.014 + np.array([-0.04, 0.04]) * moment + rng.normal(0.0, 5e-4, 2)
        turn *= [-1.0 if finger in mirrored else 1.0 for finger in FINGERS]
        wrench = own["wrench"] + np.array([0.0, 0.0, 0.0, 0.0, moment - own["wrench"][4], 0.0])
        presses.append({**own, "wrench": wrench, "turn": turn})
    found = contradictions(presses, signals)
    assert len(found) == len(named)
    assert all(text in one.text for text, one in zip(named, found, strict=True))
    if named and mirrored is not FINGERS:
        assert found[0].changes == [(mirrored[0], "mirror", True)]
    # Few presses, or moments alike, do not tell which gel.
    few = [contradictions(some, signals) for some in (presses[:1], presses[1:2], 6 * presses[2:3])]
    assert [len(one) for one in few] == {"left": [1, 0, 0], "right": [0, 1, 1]}.get(
        "".join(mirrored), [len(named)] * 3
    )


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"first": 2, "order": "planes"}, ""),
        ({"first": 2}, "do not begin on a grid"),  # the other order
        ({"order": "planes"}, "do not begin on a grid"),  # two numbers before it
        ({"first": 128, "order": "planes"}, "do not begin on a grid"),  # displacements
        ({"first": 2, "order": "planes", "turn_deg": 90}, "do not begin on a grid"),
    ],
)
def test_numbers_that_are_no_positions_of_a_grid_are_refused(changes, named):
    source = mapping.TactileSource(source="/left", kind="positions", **changes)
    rng = np.random.default_rng(8)
    at = mapping.NOMINAL_PX + rng.normal(0.0, 2.0, (63, 2))
    row = np.r_[7.0, 9.0, at[:, 0], at[:, 1], rng.normal(0.0, 1.0, 126)]
    with pytest.raises(InputError, match=named) if named else nullcontext():
        found = source.converted([row])
        np.testing.assert_allclose(found - found.mean(axis=1), [at - at.mean(axis=0)], atol=1e-9)
    backwards = np.r_[7.0, 9.0, at[::-1].T.ravel(), np.zeros(126)]
    with pytest.raises(InputError, match="do not begin on a grid"):
        source.converted([backwards])


def test_a_mapping_is_proposed_from_the_signals_of_a_bag(tmp_path, capsys):
    found = {one.name: one[1:] for one in recording_contents(FOREIGN / "press.mcap")}
    assert {
        name: (kind.rpartition("/")[2], *size[:2]) for name, (kind, *size) in found.items()
    } == {
        "/ft_sensor": ("WrenchStamped", 6, 594),
        "/gel_left/compressed": ("CompressedImage", 0, 60),
        "/gel_right/markers": ("Float64MultiArray", 126, 58),
        "/tool_pose": ("PoseStamped", 7, 581),
    }
    assert found["/ft_sensor"][-1] == pytest.approx(250.4, abs=0.1)
    path = tmp_path / "map.toml"
    words = ["import", "mcap", str(FOREIGN / "press.mcap"), "--map", str(path)]
    assert main([*words, "--dataset", str(tmp_path / "ds")]) == 1
    assert f"A mapping to correct is in {path}" in capsys.readouterr().out
    proposed, good = (read_settings(ImportMapping, file) for file in (path, MAP))
    places = [[one.source for one in each.sources.values()] for each in (proposed, good)]
    assert places[0] == places[1]
    assert proposed.grips == good.grips
    assert (proposed.left.kind, proposed.right.kind) == ("images", "positions")


def test_what_no_signal_fits_stays_open_in_a_proposal():
    scene = RecordedSignal("/scene/left", "sensor_msgs/msg/Image", 0, 9, 30.0)
    joints = RecordedSignal("/joint_states", "sensor_msgs/msg/JointState", 2, 9, 100.0)
    proposed = tomllib.loads(propose_mapping([scene, joints]))
    sources = {name: one["source"] for name, one in proposed.items() if name != "grips"}
    assert sources == {"wrench": "", "pose": "", "left": "/scene/left", "right": ""}


def test_a_bag_of_two_files_is_listed_as_one_and_a_damaged_one_is_refused(tmp_path):
    for name in ("bag_0.mcap", "bag_1.mcap"):
        shutil.copyfile(FOREIGN / "press.mcap", tmp_path / name)
    assert recording_contents(tmp_path)[0][:4] == (
        "/ft_sensor", "geometry_msgs/msg/WrenchStamped", 6, 2 * 594
    )  # fmt: skip
    whole = (FOREIGN / "press.mcap").read_bytes()
    (tmp_path / "bag_1.mcap").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged or foreign"):
        recording_contents(tmp_path)


def test_a_reading_that_is_cancelled_ends_its_process_at_once(tmp_path):
    cancelled = threading.Event()
    cancelled.set()
    with pytest.raises(InputError, match="Cancelled"):
        list(read_foreign("mcap", FOREIGN / "press.mcap", 60.0, MAP, cancelled))


def test_a_lerobot_data_set_with_its_own_features_comes_in(tmp_path, bag):
    """25 rows a second; wrench and pose share a feature, the gels are in a video and an array."""
    values = next(mapping.read("mcap", FOREIGN / "press.mcap", MAP)).values
    t_s = np.arange(0.05, 2.3, 0.04)
    state = [np.interp(t_s, values[f"{name}.t_s"], column)
             for name in ("pose", "wrench") for column in values[name].T]  # fmt: skip
    right = values["right"].reshape(len(values["right"]), -1)
    columns: dict[str, Any] = {
        "observation.state": np.stack(state, axis=1),
        "tactile.right": np.stack([np.interp(t_s, values["right.t_s"], c) for c in right.T], 1),
    }
    features = {k: {"dtype": "float32", "shape": [v.shape[1]]} for k, v in columns.items()}
    features["tactile.left"] = {"dtype": "video", "shape": [240, 320, 3]}
    folder = tmp_path / "set"
    for name in ("meta/episodes", "data", "videos"):
        (folder / name).mkdir(parents=True)
    info = {"codebase_version": "v3.0", "fps": 25, "features": features,
            "video_path": "videos/{video_key}.mp4"}  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    film = {f"videos/tactile.left/{name}": 0 for name in
            ("chunk_index", "file_index", "from_timestamp")}  # fmt: skip
    row = pa.Table.from_pylist([film | {"episode_index": 0, "length": len(t_s)}])
    pq.write_table(row, folder / "meta/episodes/0.parquet")
    table = pa.table(
        {k: v.tolist() for k, v in columns.items()} | {"episode_index": [0] * len(t_s)}
    )
    pq.write_table(table, folder / "data/0.parquet")
    films = read_settings(ImportMapping, MAP).left
    pictures = [one for _, one in mapping.read_messages([FOREIGN / "press.mcap"], films)]
    with av.open(str(folder / "videos/tactile.left.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for at_s in t_s:
            nearest = int(np.abs(values["left.t_s"] - at_s).argmin())
            frame = av.VideoFrame.from_ndarray(pictures[nearest], format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    path = tmp_path / "map.toml"
    path.write_text(
        '[pose]\nsource = "observation.state"\nunit = "mm"\naxes = ["x", "y", "z"]\n'
        '[wrench]\nsource = "observation.state"\nfirst = 3\nforce_unit = "N"\n'
        'moment_unit = "N m"\naxes = ["x", "y", "z"]\nacts_on = "tool"\n'
        '[left]\nsource = "tactile.left"\nkind = "images"\nturn_deg = 180\n'
        '[right]\nsource = "tactile.right"\nkind = "positions"\n'
    )
    (episode,) = mapping.read("lerobot", folder, path)
    assert (episode.grip, episode.mounting) == ("episode-0", "set")
    (onset_s,) = find_presses(episode.values)
    press = cut_press(episode, 0, onset_s, read_settings(ImportMapping, path))
    assert (press.grip, press.mounting) == ("", "")
    assert contradictions([measure_press(press)], read_settings(ImportMapping, path)) == []
    assert press.quality.accepted
    with np.load(FOREIGN / "truth.npz") as truth:
        markers = press.values["observation.markers"] - truth["observation"][:, :252]
    assert np.sqrt((markers**2).mean()) < 0.5
    info |= {"total_frames": len(t_s)}
    (folder / "meta/info.json").write_text(json.dumps(info))
    assert recording_format(folder) == "lerobot"
    assert recording_contents(folder) == [
        ("observation.state", "float32", 9, len(t_s), 25.0),
        ("tactile.left", "video", 0, len(t_s), 25.0),
        ("tactile.right", "float32", 126, len(t_s), 25.0),
    ]
    assert 'source = "tactile.left"' in propose_mapping(recording_contents(folder))
    numbered = path.read_text() + '[grips]\ngrip = "episode_index"\nmounting = "recording"\n'
    info["features"]["episode_index"] = {"dtype": "int64", "shape": [1]}
    (folder / "meta/info.json").write_text(json.dumps(info))
    (tmp_path / "numbered.toml").write_text(numbered)
    (episode,) = mapping.read("lerobot", folder, tmp_path / "numbered.toml")
    press = cut_press(episode, 0, onset_s, read_settings(ImportMapping, tmp_path / "numbered.toml"))
    assert (press.grip, press.mounting) == ("0", "set/episode-0")
    for change, named in (
        ({"codebase_version": "v2.1"}, "'tactile.left' is 'video' in version v2.1"),
        ({"features": features | {"tactile.left": {"dtype": "image", "shape": [240, 320, 3]}}},
         "'tactile.left' is 'image' in version v3.0"),
    ):  # fmt: skip
        (folder / "meta/info.json").write_text(json.dumps(info | change))
        with pytest.raises(InputError, match=named) as refused:
            list(read_foreign("lerobot", folder, 60.0, path))
        assert "Convert the dataset to v3.0 with videos" in refused.value.fix


GRIPPED = """
[wrench]
source = "/signals"
force_unit = "N"
moment_unit = "N m"
axes = ["x", "y", "z"]
acts_on = "tool"
[pose]
source = "/signals"
first = 6
unit = "mm"
axes = ["x", "y", "z"]
origin_mm = [400.0, 100.0]
[left]
source = "/left"
kind = "displacements"
[right]
source = "/right"
kind = "displacements"
"""
PRESSES, PERIOD_S = 4, 4.0  # of a recording


def write_presses(path: Path, number: int) -> None:
    """Write a bag of four presses. Before the first and the third the topic /grip counts on."""
    rng = np.random.default_rng(number)
    offsets = rng.uniform(-6.0, 6.0, (PRESSES, 2))

    def depth_mm(t_s: float) -> float:
        after = t_s % PERIOD_S - 1.0
        pressed = min(2.0 * after, 0.2) + min(max(after - 0.3, 0.0), 0.8)
        return pressed if 0.0 < after < 2.3 else 0.0

    def signals(t_s: float) -> list[float]:
        z_mm = 30.0 - depth_mm(t_s) + 2.0 * max(1.0 - t_s % PERIOD_S, 0.0)
        wrench = rng.normal(0.0, np.repeat([0.02, 0.0005], 3))
        wrench += 10.0 * depth_mm(t_s) * np.array([0.0, 0.0, 1.0, 0.02, 0.0, 0.0])
        hand = offsets[int(t_s / PERIOD_S)] + (400.0, 100.0)
        return [*wrench, *hand, z_mm]

    def markers(t_s: float) -> list[float]:
        moved = rng.normal(0.0, 0.02, (63, 2))
        moved[:, 1] -= 17.0 * depth_mm(t_s)
        return moved.ravel().tolist()

    span_s = PRESSES * PERIOD_S
    sent = [(t_s, "/signals", signals(t_s)) for t_s in np.arange(0.0, span_s, 0.008)]
    sent += [(t_s, name, markers(t_s)) for name in ("/left", "/right")
             for t_s in np.arange(0.01, span_s, 0.04)]  # fmt: skip
    sent += [(t_s, "/grip", [2.0 * number + k]) for k, t_s in enumerate((0.5, 8.5))]
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream)
        schema = writer.register_msgdef("lab/msg/Numbers", "float64[] data")
        for t_s, topic, row in sorted(sent):
            stamp_ns = 10**18 + round(1e9 * t_s)
            writer.write_message(topic, schema, {"data": row}, stamp_ns, stamp_ns)
        writer.finish()


@pytest.fixture(scope="module")
def days(tmp_path_factory):
    """Two folders of three bags, one of them split into two files."""
    folder = tmp_path_factory.mktemp("lab") / "days"
    folder.mkdir()
    for number in range(6):
        write_presses(folder / ("monday", "tuesday")[number // 3] / f"{number}.mcap", number)
    return folder


def test_presses_of_named_grips_and_mountings_can_be_identified(tmp_path, days, capsys):
    words = ["import", "mcap", str(days), "--piece", "pot", "--bottom", "square15", "--map"]
    said = []
    for name, source, grips in (
        ("unknown", days / "monday/0.mcap", ""),
        ("named", days, '[grips]\ngrip = "recording"\nmounting = "folder"\n'),
    ):
        path, words[2] = tmp_path / f"{name}.toml", str(source)
        path.write_text(GRIPPED + grips)
        assert main([*words, str(path), "--dataset", str(tmp_path / name)]) == 0
        said.append(capsys.readouterr().out)
    unknown, named = said
    assert "Episodes found: 24, present already: 0." in named
    assert "unknown counts as one for the whole import ([grips])" in unknown
    assert "Grips: 6; mountings: monday, tuesday." in named
    with Dataset.open(tmp_path / "unknown", write=False) as dataset:
        presses = read_recordings(dataset).presses
        assert {one.grip for one in presses} == {f"{dataset.episodes()[0].series}/unknown"}
        with pytest.raises(InputError, match="1 grippings") as refused:
            refuse_unusable(6 * presses, load_pieces(), "here")
    assert "[grips] of the mapping" in refused.value.fix
    with Dataset.open(tmp_path / "named", write=False) as dataset:
        found = read_recordings(dataset)
    assert not found.simulated
    refuse_unusable(found.presses, load_pieces(), "here")
    assert all(one.imported for one in found.presses)
    names = [(one.grip, one.mounting) for one in found.presses]
    assert {one: names.count(one) for one in names} == {
        (f"{day}/{number}", day): PRESSES
        for day, numbers in (("monday", range(3)), ("tuesday", range(3, 6)))
        for number in numbers
    }
    sampled = sample_presses(found.presses, Delays())
    held_out = {sampled.grips[sampled.grip[row]] for row in split_grips(sampled)[1]}
    assert sorted(name.split("/")[0] for name in held_out) == ["monday", "tuesday"]
    offsets = np.random.default_rng(5).uniform(-6.0, 6.0, (PRESSES, 2))
    own = [one.offset_mm for one in found.presses if one.grip == "tuesday/5"]
    np.testing.assert_allclose(np.sort(own, axis=0), np.sort(offsets, axis=0), atol=0.002)
    # A file alone, or a copy of it, is known.
    words[2] = str(days / "monday/1.mcap")
    assert main([*words, str(path), "--dataset", str(tmp_path / "named")]) == 0
    assert "Episodes found: 4, present already: 4." in capsys.readouterr().out


def test_a_copy_of_a_recording_counts_once(tmp_path, days, capsys):
    bag = tmp_path / "bag"
    bag.mkdir()
    for name in ("a.mcap", "b.mcap"):
        shutil.copyfile(days / "monday/0.mcap", bag / name)
    path = tmp_path / "map.toml"
    path.write_text(GRIPPED)
    words = ["import", "mcap", str(bag), "--piece", "pot", "--bottom", "square15",
             "--dataset", str(tmp_path / "ds"), "--map", str(path)]  # fmt: skip
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "Episodes found: 4, present already: 0." in out
    assert ": 4. Their labels are drafts." in out


def test_the_files_of_one_bag_are_one_recording(tmp_path):
    bag = tmp_path / "monday/bag.1.mcap"
    bag.mkdir(parents=True)
    (bag / "metadata.yaml").touch()
    shutil.copyfile(FOREIGN / "press.mcap", bag / "bag_0.mcap")
    for source in (bag, bag / "bag_0.mcap", tmp_path):
        (episode,) = mapping.read("mcap", source, MAP)
        assert (episode.grip, episode.mounting) == ("bag.1", "monday")


@pytest.mark.parametrize(
    ("grip", "mounting", "named"),
    [
        ("/grip", "folder", [("10", "tuesday"), ("11", "tuesday")]),
        ("/grip", "unknown", [("10", ""), ("11", "")]),
        ("recording", "/grip", [("5", "tuesday/10"), ("5", "tuesday/11")]),
        ("unknown", "recording", [("", "tuesday/5")] * 2),
        ("folder", "folder", [("tuesday", "tuesday")] * 2),
    ],
)
def test_the_number_of_a_grip_is_the_newest_at_the_contact(tmp_path, days, grip, mounting, named):
    path = tmp_path / "map.toml"
    path.write_text(f'{GRIPPED}[grips]\ngrip = "{grip}"\nmounting = "{mounting}"\n')
    (episode,) = mapping.read("mcap", days / "tuesday/5.mcap", path)
    signals = read_settings(ImportMapping, path)
    presses = [cut_press(episode, k, t_s, signals)
               for k, t_s in enumerate(find_presses(episode.values))]  # fmt: skip
    assert [(one.grip, one.mounting) for one in presses] == [named[0]] * 2 + [named[1]] * 2
