"""Foreign files: read in a child process, with one error for any failure."""

from __future__ import annotations

import csv
import errno
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import h5py
import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.backend.annotations.conftest import context_for
from tests.backend.exchange.conftest import recorded_episode
from touchdown.backend.annotations import SPLIT_TAG, Dataset, Label, Pair
from touchdown.backend.core import MARKERS, Fault, FaultError, InputError, Recording
from touchdown.backend.exchange import coco, csv_tables, export, foreign_child
from touchdown.backend.exchange.features import ForeignEpisode
from touchdown.backend.exchange.imports import (
    EpisodeImport,
    ImportOptions,
    mapping_problem,
    read_foreign,
)
from touchdown.backend.exchange.label_import import LabelImportResult, import_labels
from touchdown.backend.geometry import (
    circle,
    face_points,
    load_pieces,
    overlap_polygon,
    rings_of,
    true_patch,
)
from touchdown.backend.simulation.scene_camera import camera_matrix

NAMED = ImportOptions("dora", "dora", "pot", "circle15")
PARQUET = "data/chunk-000/file-000.parquet"


def lerobot_21(folder: Path, fps: int = 10, rows: int = 20, **widths: int) -> Path:
    """A dataset of version 2.1: one parquet file per episode. ``widths`` of its features."""
    rng = np.random.default_rng(2)
    features = {
        f"observation.{name}": {"dtype": "float32", "shape": [width], "names": None}
        for name, width in ({"markers": 252, "ft": 6} | widths).items()
        if width
    }
    (folder / "meta").mkdir(parents=True)
    info = {"codebase_version": "v2.1", "fps": fps, "features": features, "video_path": None,
            "splits": {"train": "0:2"}}  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    for k in range(2):
        columns: dict[str, Any] = {
            key: rng.normal(size=(rows, *f["shape"])).astype(np.float32).tolist()
            for key, f in features.items()
        }
        columns |= {"episode_index": [k] * rows, "frame_index": list(range(rows))}
        path = folder / f"data/chunk-000/episode_{k:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns), path)
    return folder


@pytest.fixture
def back(tmp_path: Path) -> Any:
    with Dataset.open(tmp_path / "back") as dataset:
        yield dataset


def test_lerobot_21_comes_in(back, tmp_path):
    written = EpisodeImport(back, "lerobot", lerobot_21(tmp_path / "old"), NAMED).write()
    assert len(written) == 2
    # All on the side "train" is no split.
    assert [back.labels.marks(uuid) for uuid in written] == [{}, {}]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"markers": 0}, "it lacks observation.markers"),
        ({"rows": 50, "ft": 6}, "observation.markers has shape (50, 252)"),
        ({"ft": 5}, "observation.ft has shape (20, 5)"),
    ],
)
def test_what_cannot_be_mapped_is_told_and_not_written(changes, why, back, tmp_path):
    path = lerobot_21(tmp_path / "set", **changes)
    survey = EpisodeImport(back, "lerobot", path, NAMED).survey()
    assert survey.fit == 0
    assert why in survey.problems[0][0]
    assert EpisodeImport(back, "lerobot", path, NAMED).write() == []
    assert back.episodes() == []


def test_a_value_that_is_not_finite_is_not_mapped():
    values = {
        "observation.markers": np.full((20, 252), np.nan),
        "observation.ft": np.zeros((20, 6)),
    }
    assert "not finite" in mapping_problem(ForeignEpisode(0, 10.0, values))


def test_another_rate_is_not_taken_for_ours(back, tmp_path):
    survey = EpisodeImport(back, "lerobot", lerobot_21(tmp_path / "fast", fps=30), NAMED).survey()
    assert survey.problems == (("it has 30 ticks per second, not 10", 2),)


@pytest.mark.parametrize("content", [b"", b"PAR1" + b"\x00" * 500 + b"PAR1", b"x" * 5000])
def test_a_damaged_file_is_one_sentence(content, tmp_path):
    folder = lerobot_21(tmp_path / "set")
    (folder / "data/chunk-000/episode_000000.parquet").write_bytes(content)
    with pytest.raises(InputError, match="damaged or foreign"):
        list(read_foreign("lerobot", folder))


def test_a_reader_that_takes_too_long_is_given_up(tmp_path):
    path = lerobot_21(tmp_path / "set")
    with pytest.raises(InputError, match="not read within"):
        list(read_foreign("lerobot", path, deadline_s=1e-3))


@pytest.mark.promise("P7", "P10")
def test_a_reader_that_dies_is_told(tmp_path):
    with pytest.raises(InputError, match="crashed"):
        list(read_foreign("no such reader", tmp_path))


def test_a_file_that_is_written_during_the_deletion_is_deleted_too(tmp_path, monkeypatch):
    folder, remove, left = tmp_path / "import", shutil.rmtree, [2]
    folder.mkdir()

    def rmtree(path, **options):
        remove(path, **options)
        if left[0]:
            left[0] -= 1
            folder.mkdir()

    monkeypatch.setattr(foreign_child.shutil, "rmtree", rmtree)
    monkeypatch.setattr(foreign_child.os, "read", lambda *_: b"")
    monkeypatch.setattr(foreign_child.os, "_exit", lambda code: None)
    foreign_child._leave_with_parent(str(folder))
    assert not folder.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_killed_import_leaves_neither_its_reader_nor_its_files(tmp_path):
    """The reader writes into the temporary folder of the program, which no longer deletes it."""
    code = (
        "from pathlib import Path; from touchdown.backend.exchange.imports import read_foreign;"
        f"episodes = read_foreign('lerobot', Path({str(lerobot_21(tmp_path / 'set'))!r}));"
        "next(episodes); print('read', flush=True); input()"
    )
    place = tmp_path / "temporary"
    place.mkdir()
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(place)},
    ) as child:  # fmt: skip
        assert child.stdout is not None
        assert child.stdout.readline() == b"read\n"
        readers = psutil.Process(child.pid).children()
        assert [path.name for path in place.iterdir()]
        child.kill()
    gone, alive = psutil.wait_procs(readers, timeout=20.0)
    assert (len(gone), alive, list(place.iterdir())) == (1, [], [])


def test_a_reader_without_a_listener_waits_for_the_deletion_of_its_files(tmp_path, monkeypatch):
    def broken(*_: object) -> None:
        raise BrokenPipeError

    def leave(folder: str) -> None:
        threading.Event().wait(0.3)
        left.append(folder)

    left: list[str] = []
    monkeypatch.setattr(foreign_child, "_leave_with_parent", leave)
    monkeypatch.setattr("resource.setrlimit", lambda *_: None)
    monkeypatch.setattr("sys.stdout", SimpleNamespace(write=broken, flush=broken))
    foreign_child.main("lerobot", str(lerobot_21(tmp_path / "set")), str(tmp_path))
    assert left == [str(tmp_path)]


def test_a_full_disk_of_temporary_files_is_told(tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    told = []
    monkeypatch.setattr(foreign_child, "save_foreign", full)
    monkeypatch.setattr(foreign_child, "_tell", told.append)
    monkeypatch.setattr(foreign_child, "_leave_with_parent", lambda folder: None)
    monkeypatch.setattr("resource.setrlimit", lambda *_: None)
    foreign_child.main("lerobot", str(lerobot_21(tmp_path / "set")), str(tmp_path))
    (answer,) = told
    assert answer["error"] == "The disk of temporary files is full."
    assert "TMPDIR" in answer["fix"]


def test_newer_versions_are_refused(tmp_path):
    folder = lerobot_21(tmp_path / "new")
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | {"codebase_version": "v9.0"}))
    with pytest.raises(InputError, match=r"v9\.0"):
        list(read_foreign("lerobot", folder))


def edit_csv(path: Path, change: Callable[[list[dict[str, str]]], None]) -> None:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    change(rows)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def edit_json(path: Path, change: Callable[[Any], None]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def take(dataset: Dataset, out: Path, kind: str) -> LabelImportResult:
    read = coco.read_coco if kind == "coco" else csv_tables.read_csv
    return import_labels(dataset, read(out, dataset), "ann", "test")


@pytest.mark.parametrize("kind", ["csv", "coco"])
def test_unchanged_labels_come_back_as_the_same(kind, hand, dataset):
    done = take(dataset, hand(kind).folder, kind)
    assert (done.changed, done.unchanged, done.refused, done.warnings) == (0, 6, (), ())


@pytest.mark.promise("D9")
@pytest.mark.parametrize("name", ["=1+1", "+cmd|'x'!A1", "-2", "@sum(a1)", "\t=1"])
def test_a_cell_that_a_spreadsheet_would_calculate_is_text(name):
    assert csv_tables.as_text(name) == f"'{name}"
    assert csv_tables.as_text(f"ann {name}") == f"ann {name}"


@pytest.mark.promise("D9")
def test_the_person_of_a_table_is_shown_as_written(hand, dataset):
    with dataset.database.transaction() as rows:
        rows.execute("UPDATE episode SET person = '=HYPERLINK(1)'")
    with (hand("csv").folder / "episodes.csv").open(newline="") as file:
        assert {row["person"] for row in csv.DictReader(file)} == {"'=HYPERLINK(1)"}


def test_the_table_says_what_the_labels_say(hand, dataset):
    with (hand("csv").folder / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        label = dataset.labels.head(row["uuid"]).label
        assert [row["x_mm"], row["y_mm"]] == [f"{v / 1e3:.3f}" for v in label.offset_mm * 1e3]
        assert int(row["theta_deg"].replace(".", "")) == label.theta_mdeg
        assert row["recorded_utc"].endswith("+00:00")
        pair = dataset.geometry.pair(dataset.entry(row["uuid"]).geometry)
        face = shapely.Point(*label.offset_mm).buffer(pair.face.radius_mm, quad_segs=256)
        both = face & shapely.Point(0, 0).buffer(pair.bottom.radius_mm, quad_segs=256)
        centre = shapely.Point(*label.offset_mm)
        margin = centre.distance(both.exterior) * (1 if both.contains(centre) else -1)
        assert float(row["margin_mm"]) == pytest.approx(margin, abs=0.01)
        assert row["stable"] == ("true" if margin > 0 else "false")


def test_a_changed_row_is_a_draft_of_the_person(hand, dataset):
    out = hand("csv").folder

    def move(rows: list[dict[str, str]]) -> None:
        for row in rows:
            row["x_mm"] = "3.250"

    edit_csv(out / "episodes.csv", move)
    operations = dataset.database.one("SELECT count(*) FROM op")
    done = take(dataset, out, "csv")
    # All but ann's own, which waits for review.
    assert (done.changed, [why for _, why in done.refused]) == (
        5, ["It waits for review: undo the submission, or let the reviewer reject it."]
    )  # fmt: skip
    uuid = dataset.episodes()[0].uuid
    head, counting = dataset.labels.head(uuid), dataset.labels.counting(uuid)
    assert (head.label.x_um, head.source, head.state) == (3250, "human", "draft")
    assert head.person == "ann"
    assert counting.label.x_um == -2501
    assert [op.verb for op in dataset.labels.log(limit=1)] == ["import"]
    with closing(sqlite3.connect(done.backup)) as kept:
        assert kept.execute("SELECT count(*) FROM op").fetchone() == operations
        assert kept.execute("SELECT count(*) FROM label_rev WHERE x_um = 3250").fetchone() == (0,)
    assert take(dataset, out, "csv").backup is None


def test_two_rows_of_one_episode_leave_one_label(hand, dataset):
    out = hand("csv").folder
    edit_csv(out / "episodes.csv", lambda rows: rows.append({**rows[0], "x_mm": "4.000"}))
    edit_csv(out / "episodes.csv", lambda rows: rows[0].update(x_mm="3.000"))
    done = take(dataset, out, "csv")
    assert (done.changed, done.refused[-1][1]) == (1, "An earlier row has the same episode.")
    assert dataset.labels.head(done.refused[-1][0]).label.x_um == 3000
    assert not sum(one.conflicts for one in dataset.count_by_pair())


def test_rows_match_by_the_hash_of_the_file_too(hand, dataset):
    out = hand("csv").folder
    edit_csv(out / "episodes.csv", lambda rows: [row.update(uuid="") for row in rows])
    assert take(dataset, out, "csv").unchanged == 6
    edit_csv(out / "episodes.csv", lambda rows: rows[0].update(file_sha256="0" * 64))
    done = take(dataset, out, "csv")
    assert [why for _, why in done.refused] == ["There is no such episode here."]


@pytest.mark.parametrize(
    ("column", "text", "why"),
    [("x_mm", "one", "no number"), ("y_mm", "0.0001", "finer than"), ("x_mm", "1e99", "too large"),
     ("x_mm", "", "no offset"), ("sigma_mm", "nan", "no number"), ("y_mm", "2500", "too large"),
     ("sigma_mm", "-0.1", "negative"), ("theta_deg", "7200", "too large")],
)  # fmt: skip
def test_a_bad_row_is_named(column, text, why, hand, dataset):
    out = hand("csv").folder
    edit_csv(out / "episodes.csv", lambda rows: rows[1].update({column: text}))
    with pytest.raises(InputError, match=why) as error:
        take(dataset, out, "csv")
    assert "line 3" in error.value.where


def test_polygons_are_the_overlap_of_the_outlines(hand, dataset):
    out = hand("coco").folder
    content = json.loads((out / "annotations.json").read_text())
    images = {image["id"]: image for image in content["images"]}
    for annotation in content["annotations"]:
        if annotation["category_id"] != 1:
            continue
        image = images[annotation["image_id"]]
        label = dataset.labels.head(image["episode"]).label
        pair = dataset.geometry.pair(image["pair"])
        face = shapely.Point(*label.offset_mm).buffer(pair.face.radius_mm, quad_segs=256)
        both = face & shapely.Point(0, 0).buffer(pair.bottom.radius_mm, quad_segs=256)
        assert annotation["area"] / 400 == pytest.approx(both.area, rel=0.002)
        drawn = shapely.Polygon(list(zip(*[iter(annotation["segmentation"][0])] * 2, strict=True)))
        assert drawn.area == pytest.approx(annotation["area"], rel=1e-6)
        assert (out / image["file_name"]).is_file()


def test_outlines_lie_on_the_pictures_of_the_scene_camera(seen, hand):
    out = hand("coco", of=seen, states=("draft",)).folder
    content = json.loads((out / "annotations.json").read_text())
    images = {image["id"]: image for image in content["images"]}
    assert len(images) == len({image["file_name"] for image in images.values()}) == 2 * 3
    turn = np.linspace(0.0, 2.0 * np.pi, 256)
    round_mm = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    compared = 0
    for annotation in content["annotations"]:
        image = images[annotation["image_id"]]
        episode, pair = seen.read(image["episode"]), seen.geometry.pair(image["pair"])
        if annotation["category_id"] not in (2, 3):
            continue
        shown = cv2.imread(str(out / image["file_name"])).astype(int)
        assert np.abs(shown - episode.recording.scene[0].image).mean() < 2.0
        label = seen.labels.head(episode.episode_id).label
        face_mm = pair.face.radius_mm * round_mm + label.offset_mm
        ring = face_mm if annotation["category_id"] == 2 else pair.bottom.radius_mm * round_mm
        projected = np.insert(ring, 2, [[0.0], [1.0]], axis=1) @ camera_matrix().T
        true = shapely.Polygon(projected[:, :2] / projected[:, 2:])
        drawn = shapely.Polygon(np.reshape(annotation["segmentation"][0], (-1, 2)))
        assert true.symmetric_difference(drawn).area < 0.01 * true.area
        compared += 1
    assert compared == 4
    assert take(seen, out, "coco").changed == 0


def test_markers_are_keypoints_of_the_tactile_pictures(seen, hand):
    out = hand("coco", of=seen, states=("draft",)).folder
    content = json.loads((out / "annotations.json").read_text())
    gels = [a for a in content["annotations"] if a["category_id"] == 4]
    images = {image["id"]: image for image in content["images"]}
    episode = seen.read(images[gels[0]["image_id"]]["episode"])
    last_s = episode.onset_s + 2.0
    left = [f for f in episode.recording.fields if f.finger == "left"]
    field = min(left, key=lambda f: abs(f.t_s - last_s))
    points = np.reshape(gels[0]["keypoints"], (MARKERS, 3))
    assert np.array_equal(points[:, 2], 2 - field.state)
    kept = field.state < 2
    np.testing.assert_allclose(points[kept, :2], field.position_px[kept], atol=1e-4)
    assert not points[~kept].any()


def test_annotations_of_earlier_versions_are_read(hand, dataset):
    out = hand("coco").folder

    def age(content: Any) -> None:
        content["info"] |= {"px_per_mm": 20.0, "origin_px": {}}
        for image in content["images"]:
            (_, _, u), (_, _, v), _ = image.pop("homography")
            content["info"]["origin_px"][image["pair"]] = [u, v]
        content["annotations"] = [a for a in content["annotations"] if a["category_id"] == 1]

    edit_json(out / "annotations.json", age)
    assert take(dataset, out, "coco").changed == 0


@pytest.mark.parametrize(("bottom", "parts"), [("ring24", 0), ("feet3", 3), ("channel20", 1)])
def test_patches_with_holes_are_run_lengths_and_parts_are_polygons(bottom, parts):
    below, face = load_pieces().bottom(bottom).face, circle(25.4)
    canvas = coco.drawn_canvas(Pair("", face, below, (0.0, 0.0), 1.0))
    size, offset = canvas.size[::-1], np.array([1.5, -0.7])
    rings = rings_of(canvas.px(overlap_polygon(face, (1.5, -0.7), below)))
    drawn = shapely.Polygon()
    for ring in rings:
        drawn ^= shapely.Polygon(ring)
    shape = coco._shape(rings, size)
    assert shape["area"] == pytest.approx(drawn.area, rel=1e-6)
    points = face_points(face)
    touching = true_patch(points, offset, below)
    at_px = canvas.px(points + offset)
    assert coco._iou(shape["segmentation"], at_px, touching) == 1.0
    assert coco._iou(shape["segmentation"], at_px + 20.0, touching) < 0.9
    if parts:
        assert len(shape["segmentation"]) == parts
        return
    counts = shape["segmentation"]["counts"]
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    columns, rows = np.meshgrid(np.arange(size[1]), np.arange(size[0]), indexing="ij")
    expected = shapely.contains_xy(drawn, columns.ravel(), rows.ravel())
    assert flat.size == size[0] * size[1]
    assert (flat != expected).sum() < 1e-3 * expected.sum()


def test_a_moved_keypoint_is_a_new_offset_of_unknown_sigma(hand, dataset):
    out = hand("coco").folder

    def move(content: Any) -> None:
        content["annotations"][0]["keypoints"][0] += 20.0  # 1 mm to the right
        content["annotations"][0]["keypoints"][1] += 10.0  # half a mm down

    edit_json(out / "annotations.json", move)
    uuid = json.loads((out / "annotations.json").read_text())["images"][0]["episode"]
    before = dataset.labels.head(uuid).label
    done = take(dataset, out, "coco")
    after = dataset.labels.head(uuid).label
    assert (after.x_um, after.y_um) == (before.x_um + 1000, before.y_um - 500)
    assert (after.theta_mdeg, after.sigma_um) == (before.theta_mdeg, None)
    assert done.changed == 1
    assert "overlap by" in done.warnings[0]


@pytest.mark.parametrize("text", ["", "[]", '{"info": {}}', '{"annotations": 3}'])
def test_bad_annotations_are_refused(text, hand, dataset):
    out = hand("coco").folder
    (out / "annotations.json").write_text(text)
    with pytest.raises(InputError):
        take(dataset, out, "coco")


@pytest.mark.parametrize("kind", ["csv", "lerobot"])
def test_without_its_backup_nothing_is_imported(kind, hand, dataset, monkeypatch):
    out = hand(kind).folder
    if kind == "csv":
        edit_csv(out / "episodes.csv", lambda rows: [row.update(x_mm="3.250") for row in rows])

    # The copy that was made on closing does not have this.
    dataset.labels.flag("ann", dataset.episodes()[0].uuid)

    def refuse(reason: str) -> Path:
        raise FaultError(Fault("BACKUP-FAILED", f"No room for '{reason}'.", "", ""))

    monkeypatch.setattr(dataset.backups, "make", refuse)
    before = dataset.database.one("SELECT count(*) FROM op")
    bring: dict[str, Callable[[], object]] = {
        "csv": lambda: take(dataset, out, kind),
        "lerobot": lambda: EpisodeImport(dataset, kind, out, ImportOptions("ann")).write(),
    }
    with pytest.raises(FaultError, match="No room for 'import'"):
        bring[kind]()
    assert dataset.database.one("SELECT count(*) FROM op") == before


WISH = ImportOptions("dora")
FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)
POSITION_MM = st.floats(-1e6, 1e6)
MICROMETRES = st.integers(-1_000_000, 1_000_000)


@st.composite
def probes(draw: st.DrawFn) -> tuple[Any, Any, Any, Label]:
    """Observation, measured and commanded poses, and a label."""
    label = Label(
        draw(MICROMETRES), draw(MICROMETRES), draw(st.integers(-180_000, 180_000)),
        draw(st.none() | st.integers(0, 10_000)),
    )  # fmt: skip
    poses = arrays(np.float64, (260, 3), elements=POSITION_MM)
    return draw(arrays(np.float32, (20, 258), elements=FINITE)), draw(poses), draw(poses), label


def out_of(dataset: Dataset, out: Path) -> Path:
    return export(dataset, "lerobot", out, states=("draft",), held_out=0.0, video="none").folder


@settings(
    max_examples=2, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow,
                           HealthCheck.data_too_large, HealthCheck.large_base_example],
)  # fmt: skip
@given(drawn=st.lists(probes(), min_size=2, max_size=3))
def test_any_finite_probe_comes_back_bit_by_bit(tmp_path, drawn):
    place = tmp_path / "one"
    shutil.rmtree(place, ignore_errors=True)
    with Dataset.open(place / "here") as here, Dataset.open(place / "there") as there:
        for observation, pose_mm, command_mm, label in drawn:
            episode = recorded_episode(1, frames=False)
            assert isinstance(episode.recording, Recording)
            recording = replace(episode.recording, pose_mm=pose_mm, command_mm=command_mm)
            episode = replace(episode, observation=observation, recording=recording)
            here.record(episode, label, source="measured", context=context_for(here))
        first = out_of(here, place / "first")
        EpisodeImport(there, "lerobot", first, WISH).write()
        again = out_of(there, place / "again")
        assert (again / PARQUET).read_bytes() == (first / PARQUET).read_bytes()
        mine = [here.read(e.uuid).observation.tobytes() for e in here.episodes()]
        theirs = [there.read(e.uuid).observation.tobytes() for e in there.episodes()]
        assert theirs == mine
        labels = [[d.labels.head(e.uuid).label for e in d.episodes()] for d in (here, there)]
        assert labels[0] == labels[1]


@given(value=st.none() | st.integers(-(10**5), 10**5))
def test_any_thousandth_is_read_as_it_was_written(value):
    written = csv_tables._thousandth(value)
    assert csv_tables._whole(written, "x_mm", Path("t.csv"), 2) == value


def test_half_an_export_is_refused_with_and_without_its_manifest(hand, dataset):
    out = hand("lerobot").folder
    whole = (out / PARQUET).read_bytes()
    for share in (0.0, 0.5, 0.99):
        (out / PARQUET).write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match="cut short"):
            EpisodeImport(dataset, "lerobot", out, WISH)
    (out / "manifest.json").unlink()
    wish = ImportOptions("dora", None, "pot", "circle15")
    with pytest.raises(InputError, match="damaged or foreign") as error:
        EpisodeImport(dataset, "lerobot", out, wish).survey()
    assert str(out) in error.value.where


@pytest.mark.parametrize("kind", ["csv", "coco"])
def test_labels_of_a_file_that_was_cut_are_refused(kind, hand, dataset):
    out = hand(kind).folder
    name = {"csv": csv_tables.FILE, "coco": "annotations.json"}[kind]
    whole = (out / name).read_bytes()
    read: dict[str, Callable[[], object]] = {
        "csv": lambda: list(csv_tables.read_csv(out / name, dataset)),
        "coco": lambda: list(coco.read_coco(out / name, dataset)),
    }
    for cut in (10, len(whole) // 2, len(whole) - 40):
        (out / name).write_bytes(whole[:cut])
        with pytest.raises(InputError) as error:
            read[kind]()
        assert error.value.where.startswith(str(out / name))


def manifest_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "manifest.json").read_text("utf-8"))
    return content


def by_origin(dataset: Dataset) -> dict[str, str]:
    """Imported episode by the one it was exported from."""
    found = {entry.uuid: dict(dataset.read(entry.uuid).metadata) for entry in dataset.episodes()}
    return {facts["imported_as"]: uuid for uuid, facts in found.items()}


def test_numbers_labels_and_splits_come_back(dataset, hand, tmp_path):
    first = hand("lerobot")
    with Dataset.open(tmp_path / "back") as back:
        written = EpisodeImport(back, "lerobot", first.folder, WISH).write()
        assert len(written) == 6
        origin = by_origin(back)
        for entry in dataset.episodes():
            mine, theirs = dataset.read(entry.uuid), back.read(origin[entry.uuid])
            assert mine.observation.tobytes() == theirs.observation.tobytes()
            here, there = dataset.labels.head(entry.uuid), back.labels.head(theirs.episode_id)
            assert (there.label, there.source, there.geometry) == (
                here.label, here.source, here.geometry
            )  # fmt: skip
            assert (there.state, there.person) == ("draft", "dora")
            known = back.entry(theirs.episode_id)
            assert (known.mode, known.grip_id, known.piece) == ("imported", entry.grip_id, "pot")
        assert len({entry.series for entry in back.episodes()}) == 1
        again = hand("lerobot", "again", of=back).folder
    for name in (PARQUET, "meta/info.json", "meta/tasks.parquet"):
        assert (first.folder / name).read_bytes() == (again / name).read_bytes()
    assert sides(first.folder) == {
        {new: old for old, new in origin.items()}[uuid]: side for uuid, side in sides(again).items()
    }
    assert set(sides(first.folder).values()) == {"train", "held_out"}


def sides(folder: Path) -> dict[str, str]:
    return {episode["uuid"]: episode["split"] for episode in manifest_of(folder)["episodes"]}


def test_parquet_rows_are_the_recorded_numbers(dataset, hand):
    """Read by pyarrow alone, compared with an interpolation of its own."""
    out = hand("lerobot").folder
    table = pq.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()
    for listed in manifest_of(out)["episodes"]:
        rows = slice(20 * listed["export_index"], 20 * listed["export_index"] + 20)
        episode = dataset.read(listed["uuid"])
        assert set(table["episode_index"][rows]) == {listed["export_index"]}
        markers = np.array(table["observation.markers"][rows], np.float32)
        wrench = np.array(table["observation.ft"][rows], np.float32)
        assert np.concatenate([markers, wrench], 1).tobytes() == episode.observation.tobytes()
        offset = np.array(table["label.offset_mm"][rows][7], np.float32)
        assert np.rint(offset.astype(float) * 1e3).tolist() == [
            listed["label"]["x_um"], listed["label"]["y_um"]
        ]  # fmt: skip
        patch = dataset.patch(listed["uuid"]).touching
        assert np.array(table["label.patch"][rows][3], bool).tolist() == patch.tolist()
        t_s = episode.onset_s + 0.1 * np.arange(1, 21)
        recording = episode.recording
        x_m = np.interp(t_s, recording.pose_t_s, recording.pose_mm[:, 0]) / 1e3
        state = np.array(table["observation.state"][rows], np.float32)
        np.testing.assert_allclose(state[:, 0], x_m, atol=1e-7)
        told = [max(np.flatnonzero(recording.command_t_s <= t + 0.1 + 1e-9)) for t in t_s]
        action = np.array(table["action"][rows], np.float32)
        assert action[:, :3].tolist() == (recording.command_mm[told] / 1e3).astype("f4").tolist()
        assert action[:, 3:].tolist() == [[0.0, 0.0, 0.0, 1.0]] * 20
        window = np.array(table["observation.ft_window"][rows], np.float32)
        latest = np.searchsorted(recording.wrench_t_s, t_s[4] + 1e-6, side="right") - 1
        assert window[4, -1].tolist() == recording.wrench[latest].astype(np.float32).tolist()


def test_positions_are_metres_in_the_file_and_mm_after_an_import(tmp_path, hand):
    """The arm stands at (120, -45, 31) mm and is told to go to (125, -50, 29) mm."""
    still = recorded_episode(5)
    poses, told = (np.tile(at, (260, 1)) for at in ((120.0, -45.0, 31.0), (125.0, -50.0, 29.0)))
    still = replace(still, recording=replace(still.recording, pose_mm=poses, command_mm=told))
    with Dataset.open(tmp_path / "still") as dataset:
        label = Label(1500, -2750, 0, 3)
        dataset.record(still, label, source="measured", context=context_for(dataset))
        out, hdf5 = (hand(kind, kind, of=dataset).folder for kind in ("lerobot", "robomimic"))
    rows = pq.read_table(out / PARQUET).to_pydict()
    with h5py.File(hdf5 / "demos.hdf5", "r") as file:
        demo = file["data/demo_0"]
        for state in (rows["observation.state"][7], demo["obs/state"][7]):
            assert list(state) == pytest.approx([0.120, -0.045, 0.031, 0.0, 0.0, 0.0, 1.0])
        for action in (rows["action"][7], demo["actions"][7]):
            assert list(action) == pytest.approx([0.125, -0.050, 0.029, 0.0, 0.0, 0.0, 1.0])
    with Dataset.open(tmp_path / "back") as back:
        (uuid,) = EpisodeImport(back, "lerobot", out, WISH).write()
        recording = back.read(uuid).recording
        np.testing.assert_allclose(recording.pose_mm[7], (120.0, -45.0, 31.0), atol=1e-4)
        np.testing.assert_allclose(recording.command_mm[7], (125.0, -50.0, 29.0), atol=1e-4)
        assert back.labels.head(uuid).label.offset_mm.tolist() == [1.5, -2.75]


def test_without_commanded_poses_the_action_is_the_measured_one(dataset, hand):
    """One older episode makes it so for the whole export, and the manifest says it."""
    assert manifest_of(hand("lerobot", "told").folder)["feature_spec"]["action"] == "commanded"
    older = recorded_episode(70, commands=False)
    dataset.record(older, Label(1, 2, 0, 3), source="measured", context=context_for(dataset))
    done = hand("lerobot", "older")
    assert manifest_of(done.folder)["feature_spec"]["action"] == "measured"
    assert any("do not say the commanded pose" in warning for warning in done.warnings)
    table = pq.read_table(done.folder / "data/chunk-000/file-000.parquet").to_pydict()
    state, action = (np.array(table[key][:20]) for key in ("observation.state", "action"))
    assert action[:-1].tolist() == state[1:].tolist()


def test_actions_beyond_one_are_scaled_without_loss(tmp_path, hand):
    far = recorded_episode(99)
    far.recording.command_mm.flags.writeable = True
    far.recording.command_mm[:, 2] += 5300.0
    with Dataset.open(tmp_path / "far") as dataset:
        context = context_for(dataset)
        dataset.record(far, Label(1, 2, 0, 3), source="measured", context=context)
        out = hand("robomimic", "scaled", of=dataset).folder
        plain = hand("lerobot", "plain", of=dataset).folder
    with h5py.File(out / "demos.hdf5", "r") as file:
        scale = json.loads(file["data"].attrs["env_args"])["env_kwargs"]["action_scale"]
        actions = file["data/demo_0/actions"][()]
    assert scale == 8.0
    assert np.abs(actions).max() <= 1.0
    table = pq.read_table(plain / "data/chunk-000/file-000.parquet").to_pydict()
    assert (actions * np.float32(scale)).tolist() == np.array(table["action"], np.float32).tolist()


def test_importing_twice_adds_nothing(hand, tmp_path, dataset):
    out = hand("lerobot").folder
    with Dataset.open(tmp_path / "back") as back:
        assert len(EpisodeImport(back, "lerobot", out, WISH).write()) == 6
        survey = EpisodeImport(back, "lerobot", out, WISH).survey()
        assert (survey.found, survey.here, survey.fit) == (6, 6, 0)
    # In the dataset that it came from, the episodes themselves are there.
    survey = EpisodeImport(dataset, "lerobot", out, WISH).survey()
    assert (survey.here, survey.fit) == (6, 0)


def interrupt_third(done: int) -> None:
    """Interrupt an import, as Ctrl+C does, after its third episode."""
    if done == 3:
        raise KeyboardInterrupt


def test_an_interrupted_import_goes_on(hand, tmp_path, monkeypatch):
    out = hand("lerobot").folder

    with Dataset.open(tmp_path / "back") as back:
        with pytest.raises(KeyboardInterrupt):
            EpisodeImport(back, "lerobot", out, WISH).write(interrupt_third)
        assert len(EpisodeImport(back, "lerobot", out, WISH).write()) == 3
        assert len(back.episodes()) == 6
        sides = [
            {name for name in back.labels.marks(entry.uuid) if name.startswith(SPLIT_TAG)}
            for entry in back.episodes()
        ]
        assert all(len(side) == 1 for side in sides), sides


def test_an_interrupted_import_of_unknown_grips_goes_on_in_its_grip(hand, tmp_path):
    """A split by grip must not tear one recording apart."""
    out = hand("lerobot").folder
    (out / "manifest.json").unlink()

    with Dataset.open(tmp_path / "back") as back:
        with pytest.raises(KeyboardInterrupt):
            EpisodeImport(back, "lerobot", out, NAMED).write(interrupt_third)
        assert len(EpisodeImport(back, "lerobot", out, NAMED).write()) == 3
        (count,) = back.database.one("SELECT count(DISTINCT grip_id) FROM episode")
    assert count == 1


def test_without_a_manifest_the_pair_has_to_be_named(hand, tmp_path):
    out = hand("lerobot").folder
    (out / "manifest.json").unlink()
    with Dataset.open(tmp_path / "back") as back:
        with pytest.raises(InputError, match="which pieces"):
            EpisodeImport(back, "lerobot", out, WISH)
        EpisodeImport(back, "lerobot", out, NAMED).write()
        heads = [back.labels.head(entry.uuid) for entry in back.episodes()]
        assert {head.label.x_um for head in heads} == {1000 * k - 2501 for k in range(6)}
        assert {(head.source, head.state) for head in heads} == {("human", "draft")}
    with Dataset.open(tmp_path / "nobody") as back:
        wish = ImportOptions("root", None, "pot", "circle15")
        EpisodeImport(back, "lerobot", out, wish).write()
        sources = {back.labels.head(entry.uuid).source for entry in back.episodes()}
        assert sources == {"measured"}


def test_a_changed_file_does_not_pass_for_the_export(hand, tmp_path):
    out = hand("lerobot").folder
    data = bytearray((out / PARQUET).read_bytes())
    data[len(data) // 2] ^= 1
    (out / PARQUET).write_bytes(data)
    with (
        Dataset.open(tmp_path / "back") as back,
        pytest.raises(InputError, match="changed since it was exported"),
    ):
        EpisodeImport(back, "lerobot", out, WISH)


KEY = "observation.images.tac_left"
TWO = ("submitted", "draft")  # states of two of the six episodes


def test_pictures_stand_where_the_episode_says(dataset, hand):
    out = hand("lerobot", video="all").folder
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    with av.open(str(out / f"videos/{KEY}/chunk-000/file-000.mp4")) as film:
        frames = {round(f.time * 10): f.to_ndarray(format="rgb24") for f in film.decode(video=0)}
    assert len(frames) == 120
    for listed in manifest_of(out)["episodes"]:
        row = rows[listed["export_index"]]
        start = round(row[f"videos/{KEY}/from_timestamp"] * 10)
        assert row[f"videos/{KEY}/to_timestamp"] * 10 - start == 20
        episode = dataset.read(listed["uuid"])
        mine = [f for f in episode.recording.frames if f.finger == "left"]
        for k in (0, 9, 19):
            tick_s = episode.onset_s + 0.1 * (k + 1)
            nearest = min(mine, key=lambda f: abs(f.t_s - tick_s))
            others = [f for f in mine if f is not nearest]
            shown = frames[start + k].astype(float)
            gap = [np.abs(shown - f.image[:, :, ::-1]).mean() for f in (nearest, *others)]
            assert gap[0] < 3.0
            assert gap[0] < min(gap[1:]) / 3


def test_a_sample_is_a_dataset_of_its_own(hand):
    out = hand("lerobot", video="sample").folder
    assert not (out / "videos").exists()
    assert len(list((out / "sample").rglob("*.mp4"))) == 2
    content = manifest_of(out)
    assert len(content["video"]["sampled"]) == 6
    assert content["codec"]["sample"]["video"]["codec"] == "h264"


def test_pictures_come_back_with_the_episodes(dataset, hand, tmp_path):
    compared = 0
    out = hand("lerobot", video="all", states=TWO, divide_series=True).folder
    with Dataset.open(tmp_path / "back") as back:
        EpisodeImport(back, "lerobot", out, ImportOptions("dora")).write()
        for old, new in by_origin(back).items():
            mine, theirs = dataset.read(old).recording, back.read(new).recording
            compared += 1
            assert len(theirs.frames) == 40
            last = [f for f in mine.frames if f.finger == "right"]
            shown = [f for f in theirs.frames if f.finger == "right"][-1].image.astype(float)
            assert min(np.abs(shown - f.image).mean() for f in last) < 5.0
    assert compared == 2
