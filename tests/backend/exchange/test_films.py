"""Videos of LeRobot datasets: the right images at the named times, nearly unchanged."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq

from tests.backend.exchange.conftest import Hand
from tests.backend.exchange.test_round_trip import by_origin, manifest_of
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.exchange.imports import EpisodeImport, ImportOptions
from touchdown.backend.exchange.query import ExportQuery

KEY = "observation.images.tac_left"
TWO = ExportQuery(states=("submitted", "draft"), held_out=0.4, divide_series=True)
"""Two of the six episodes."""


def test_pictures_stand_where_the_episode_says(dataset: Dataset, hand: Hand) -> None:
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
        assert episode.recording is not None
        mine = [f for f in episode.recording.frames if f.finger == "left"]
        for k in (0, 9, 19):
            tick_s = episode.onset_s + 0.1 * (k + 1)
            nearest = min(mine, key=lambda f: abs(f.t_s - tick_s))
            others = [f for f in mine if f is not nearest]
            shown = frames[start + k].astype(float)
            gap = [np.abs(shown - f.image[:, :, ::-1]).mean() for f in (nearest, *others)]
            assert gap[0] < 3.0
            assert gap[0] < min(gap[1:]) / 3


def test_a_sample_is_a_dataset_of_its_own(hand: Hand) -> None:
    out = hand("lerobot", video="sample").folder
    assert not (out / "videos").exists()
    assert len(list((out / "sample").rglob("*.mp4"))) == 2
    content = manifest_of(out)
    assert len(content["video"]["sampled"]) == 6
    assert content["codec"]["sample"]["video"]["codec"] == "h264"


def test_pictures_come_back_with_the_episodes(dataset: Dataset, hand: Hand, tmp_path: Path) -> None:
    compared = 0
    for kind, worst in (("robomimic", 3.0), ("lerobot", 5.0)):
        out = hand(kind, video="all", query=TWO).folder
        with Dataset.open(tmp_path / f"back-{kind}") as back:
            EpisodeImport(back, kind, out, ImportOptions("dora")).write()
            for old, new in by_origin(back).items():
                mine, theirs = dataset.read(old).recording, back.read(new).recording
                assert mine is not None
                assert theirs is not None
                compared += 1
                assert len(theirs.frames) == 40
                last = [f for f in mine.frames if f.finger == "right"]
                shown = [f for f in theirs.frames if f.finger == "right"][-1].image.astype(float)
                assert min(np.abs(shown - f.image).mean() for f in last) < worst
    assert compared == 4
