"""``touchdown simulate``: files, labels, JSON, determinism, bad input."""

from __future__ import annotations

import json

import numpy as np
import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.episodes.packs import read_pack_metadata
from touchdown.backend.episodes.training_rows import find_packs, load_rows
from touchdown.backend.experiments import collection
from touchdown.backend.geometry.outlines import face_points, true_patch
from touchdown.backend.geometry.pieces import load_pieces

SMALL = ["simulate", "--piece", "pot", "--bottoms", "circle15,square15", "--episodes", "6"]
SMALL += ["--probes-per-grip", "3", "--grips-per-mounting", "2", "--seed", "4", "--json"]


@pytest.fixture
def written(tmp_path, capsys):
    out = tmp_path / "data"
    assert main([*SMALL, "--workers", "1", "--out", str(out)]) == 0
    return out, json.loads(capsys.readouterr().out)


def test_json_counts_and_labels_are_complete(written) -> None:
    out, answer = written
    assert answer["episodes"] == 12
    assert answer["out"] == str(out)
    assert answer["seconds"] > 0
    rows = load_rows(out)
    assert len(rows) == 12
    assert rows.piece == "pot"
    assert sorted(set(rows.bottom)) == ["circle15", "square15"]
    assert len(set(rows.grip_id)) == 4
    assert len(set(rows.mounting_id)) == 2
    label = rows.labels[0]
    assert label["person"] == "simulation"
    assert label["source"] == "commanded"
    assert label["sigma_um"] == 512
    assert label["points"] == 177
    assert len({label["episode"] for label in rows.labels}) == 12


def test_patches_are_the_overlap_at_the_label(written) -> None:
    rows = load_rows(written[0])
    catalogue = load_pieces()
    points = face_points(catalogue.top("pot").face)
    for k, name in enumerate(rows.bottom):
        patch = true_patch(points, rows.offset_mm[k], catalogue.bottom(name).upper)
        # The label is rounded to whole micrometres: a point on the edge may change sides.
        assert np.count_nonzero(patch != rows.patch[k]) <= 1


def test_files_do_not_depend_on_the_number_of_workers(written, tmp_path, capsys) -> None:
    out, _ = written
    other = tmp_path / "other"
    assert main([*SMALL, "--workers", "2", "--out", str(other)]) == 0
    for first, second in zip(find_packs(out), find_packs(other), strict=True):
        assert first.name == second.name
        assert first.read_bytes() == second.read_bytes()


def test_packs_name_the_settings_they_were_made_with(written) -> None:
    metadata = read_pack_metadata(find_packs(written[0])[0])
    assert metadata["simulated"] == "true"
    assert json.loads(metadata["settings"])["preset"] == "mixed"
    assert metadata["probes_per_grip"] == "3"


def test_jobs_cover_every_grip_once() -> None:
    from tests.backend.simulation.test_episodes import plan

    for probes_per_grip in (1, 7, 50):
        made = plan(episodes=1234, probes_per_grip=probes_per_grip)
        jobs = collection.split_jobs(made, {}, None)
        grips = [grip for job in jobs for grip in job.grips]
        assert grips == list(range(made.grips))
        assert sum(job.episodes for job in jobs) == 1234


@pytest.mark.parametrize(
    ("extra", "word"),
    [
        (["--piece", "teapot"], "teapot"),
        (["--bottoms", "circle15,moon"], "moon"),
        (["--bottoms", "circle15,circle15"], "once"),
        (["--episodes", "0"], "--episodes"),
        (["--seed", "-1"], "--seed"),
        (["--preset", "loud"], "preset"),
        (["--bench", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_bad_input_is_one_clear_error(extra, word, tmp_path, capsys) -> None:
    out = tmp_path / "data"
    assert main(["simulate", "--out", str(out), "--json", *extra]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    error = json.loads(captured.err)["error"]
    assert word in error["what"] + error["where"] + error["fix"]
    assert not out.exists()


def test_a_folder_that_cannot_be_made_is_named(tmp_path, capsys) -> None:
    (tmp_path / "file").write_text("no folder")
    out = tmp_path / "file" / "data"
    assert main(["simulate", "--out", str(out), "--episodes", "2", "--json"]) == 2
    assert json.loads(capsys.readouterr().err)["error"]["where"] == str(out)


def test_a_folder_with_episodes_is_not_mixed_with_others(written, capsys) -> None:
    out, _ = written
    before = [path.read_bytes() for path in find_packs(out)]
    assert main([*SMALL, "--out", str(out)]) == 2
    assert [path.read_bytes() for path in find_packs(out)] == before
