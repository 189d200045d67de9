"""Labels as tables, annotations and operations: exact export, import as drafts."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import shapely

from tests.backend.exchange.conftest import Hand
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.core.faults import Fault, FaultError, InputError
from touchdown.backend.exchange import coco, csv_tables, jsonl
from touchdown.backend.exchange.imports import EpisodeImport, ImportOptions
from touchdown.backend.exchange.label_import import LabelImportResult, import_labels


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
def test_unchanged_labels_come_back_as_the_same(kind: str, hand: Hand, dataset: Dataset) -> None:
    done = take(dataset, hand(kind).folder, kind)
    assert (done.changed, done.unchanged, done.refused, done.warnings) == (0, 6, (), ())


@pytest.mark.promise("D9")
@pytest.mark.parametrize("name", ["=1+1", "+cmd|'x'!A1", "-2", "@sum(a1)", "\t=1"])
def test_a_cell_that_a_spreadsheet_would_calculate_is_text(name: str) -> None:
    assert csv_tables.as_text(name) == f"'{name}"
    assert csv_tables.as_text(f"ann {name}") == f"ann {name}"


@pytest.mark.promise("D9")
def test_the_person_of_a_table_is_shown_as_written(hand: Hand, dataset: Dataset) -> None:
    with dataset.database.transaction() as rows:
        rows.execute("UPDATE episode SET person = '=HYPERLINK(1)'")
    with (hand("csv").folder / "episodes.csv").open(newline="") as file:
        assert {row["person"] for row in csv.DictReader(file)} == {"'=HYPERLINK(1)"}


def test_the_table_says_what_the_labels_say(hand: Hand, dataset: Dataset) -> None:
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


def test_a_changed_row_is_a_draft_of_the_person(hand: Hand, dataset: Dataset) -> None:
    out = hand("csv").folder

    def move(rows: list[dict[str, str]]) -> None:
        for row in rows:
            row["x_mm"] = "3.250"

    edit_csv(out / "episodes.csv", move)
    done = take(dataset, out, "csv")
    # All but ann's own, which waits for review.
    assert (done.changed, [why for _, why in done.refused]) == (
        5, ["It waits for review: undo the submission, or let the reviewer reject it."]
    )  # fmt: skip
    uuid = dataset.episodes()[0].uuid
    head, counting = dataset.labels.head(uuid), dataset.labels.counting(uuid)
    assert (head.label.x_um, head.source, head.state) == (3250, "human", "draft")
    assert head.person == "ann"
    assert counting is not None
    assert counting.label.x_um == -2501
    assert [op.verb for op in dataset.labels.log(limit=1)] == ["import"]


def test_rows_match_by_the_hash_of_the_file_too(hand: Hand, dataset: Dataset) -> None:
    out = hand("csv").folder
    edit_csv(out / "episodes.csv", lambda rows: [row.update(uuid="") for row in rows])  # type: ignore[func-returns-value]
    assert take(dataset, out, "csv").unchanged == 6
    edit_csv(out / "episodes.csv", lambda rows: rows[0].update(file_sha256="0" * 64))
    done = take(dataset, out, "csv")
    assert [why for _, why in done.refused] == ["There is no such episode here."]


@pytest.mark.parametrize(
    ("column", "text", "why"),
    [("x_mm", "one", "no number"), ("y_mm", "0.0001", "finer than"), ("x_mm", "1e99", "too large"),
     ("x_mm", "", "no offset"), ("sigma_mm", "nan", "no number")],
)  # fmt: skip
def test_a_bad_row_is_named(column: str, text: str, why: str, hand: Hand, dataset: Dataset) -> None:
    out = hand("csv").folder
    edit_csv(out / "episodes.csv", lambda rows: rows[1].update({column: text}))
    with pytest.raises(InputError, match=why) as error:
        take(dataset, out, "csv")
    assert "line 3" in error.value.where


def test_polygons_are_the_overlap_of_the_outlines(hand: Hand, dataset: Dataset) -> None:
    out = hand("coco").folder
    content = json.loads((out / "annotations.json").read_text())
    images = {image["id"]: image for image in content["images"]}
    for annotation in content["annotations"]:
        image = images[annotation["image_id"]]
        label = dataset.labels.head(image["episode"]).label
        pair = dataset.geometry.pair(image["pair"])
        face = shapely.Point(*label.offset_mm).buffer(pair.face.radius_mm, quad_segs=256)
        both = face & shapely.Point(0, 0).buffer(pair.bottom.radius_mm, quad_segs=256)
        assert annotation["area"] / 400 == pytest.approx(both.area, rel=0.002)
        drawn = shapely.Polygon(list(zip(*[iter(annotation["segmentation"][0])] * 2, strict=True)))
        assert drawn.area == pytest.approx(annotation["area"], rel=1e-6)
        assert (out / image["file_name"]).is_file()


def test_a_moved_keypoint_is_a_new_offset_of_unknown_sigma(hand: Hand, dataset: Dataset) -> None:
    out = hand("coco").folder

    def move(content: Any) -> None:
        content["annotations"][0]["keypoints"][0] += 20.0  # 1 mm to the right
        content["annotations"][0]["keypoints"][1] += 10.0  # half a mm down

    edit_json(out / "annotations.json", move)
    uuid = json.loads((out / "annotations.json").read_text())["images"][0]["episode"]
    before = dataset.labels.head(uuid).label
    done = take(dataset, out, "coco")
    after = dataset.labels.head(uuid).label
    assert before.x_um is not None
    assert before.y_um is not None
    assert (after.x_um, after.y_um) == (before.x_um + 1000, before.y_um - 500)
    assert (after.theta_mdeg, after.sigma_um) == (before.theta_mdeg, None)
    assert done.changed == 1
    assert "overlap by" in done.warnings[0]


@pytest.mark.parametrize("text", ["", "[]", '{"info": {}}', '{"annotations": 3}'])
def test_bad_annotations_are_refused(text: str, hand: Hand, dataset: Dataset) -> None:
    out = hand("coco").folder
    (out / "annotations.json").write_text(text)
    with pytest.raises(InputError):
        take(dataset, out, "coco")


def test_the_log_brings_the_work_of_a_copy(hand: Hand, dataset: Dataset, tmp_path: Path) -> None:
    shutil.copytree(dataset.folder, tmp_path / "copy")
    (tmp_path / "copy" / "lock").unlink(missing_ok=True)
    uuid = dataset.episodes()[0].uuid
    with Dataset.open(tmp_path / "copy") as copy:
        copy.labels.set("dora", uuid, copy.labels.head(uuid).label, note="seen")
        out = hand("jsonl", of=copy).folder
    done = jsonl.import_log(dataset, out, "ann")
    assert (done.operations, done.conflicts) == (1, ())
    assert dataset.labels.head(uuid).note == "seen"
    assert jsonl.import_log(dataset, out, "ann").operations == 0


def test_an_import_keeps_the_catalogue_as_it_was(hand: Hand, dataset: Dataset) -> None:
    out = hand("csv").folder
    edit_csv(out / "episodes.csv", lambda rows: [row.update(x_mm="3.250") for row in rows])  # type: ignore[func-returns-value]
    operations = dataset.database.one("SELECT count(*) FROM op")
    done = take(dataset, out, "csv")
    assert done.backup is not None
    with closing(sqlite3.connect(done.backup)) as kept:
        assert kept.execute("SELECT count(*) FROM op").fetchone() == operations
        assert kept.execute("SELECT count(*) FROM label_rev WHERE x_um = 3250").fetchone() == (0,)
    assert take(dataset, out, "csv").backup is None


@pytest.mark.parametrize("kind", ["csv", "jsonl", "robomimic"])
def test_without_its_backup_nothing_is_imported(
    kind: str, hand: Hand, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = hand(kind).folder
    if kind == "csv":
        edit_csv(out / "episodes.csv", lambda rows: [row.update(x_mm="3.250") for row in rows])  # type: ignore[func-returns-value]

    # The copy that was made on closing does not have this.
    dataset.labels.flag("ann", dataset.episodes()[0].uuid)

    def refuse(reason: str) -> Path:
        raise FaultError(Fault("BACKUP-FAILED", f"No room for '{reason}'.", "", ""))

    monkeypatch.setattr(dataset.backups, "make", refuse)
    before = dataset.database.one("SELECT count(*) FROM op")
    bring: dict[str, Callable[[], object]] = {
        "csv": lambda: take(dataset, out, kind),
        "jsonl": lambda: jsonl.import_log(dataset, out, "ann"),
        "robomimic": lambda: EpisodeImport(dataset, kind, out, ImportOptions("ann")).write(),
    }
    with pytest.raises(FaultError, match="No room for 'import'"):
        bring[kind]()
    assert dataset.database.one("SELECT count(*) FROM op") == before


def test_a_tampered_log_is_refused(hand: Hand, dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "labels.jsonl"
    lines = (hand("jsonl").folder / "labels.jsonl").read_text().splitlines()
    path.write_text("\n".join([lines[0].replace("cleo", "eve"), *lines[1:]]) + "\n")
    with pytest.raises(InputError, match="chain of labels is broken"):
        jsonl.import_log(dataset, path, "ann")
    path.write_text("\n".join([*lines[:2], "{}"]))
    with pytest.raises(InputError, match="no operation"):
        jsonl.import_log(dataset, path, "ann")


def test_the_log_of_other_episodes_is_refused(hand: Hand, tmp_path: Path) -> None:
    out = hand("jsonl").folder
    with Dataset.open(tmp_path / "other") as other:
        with pytest.raises(InputError, match="not in this dataset"):
            jsonl.import_log(other, out, "ann")
        with pytest.raises(InputError, match="not in this dataset"):
            jsonl.import_log(other, out / "labels.jsonl", "ann")
