"""A run that collected, looked at again: its plan, its progress, and its probes."""

import csv
import io
import json

import pytest

from tests.app.label.conftest import make_episode
from touchdown.app.review.campaign import collected_run
from touchdown.app.review.episodes import list_series
from touchdown.backend.annotations import Dataset, EpisodeContext, Label
from touchdown.backend.core.events import (
    CampaignBegan,
    EpisodeDecided,
    Gripped,
    OriginChecked,
    ProbeCollected,
    RunFinished,
    RunStarted,
    Said,
)
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.campaign import new_campaign
from touchdown.backend.runs.event_log import EventLog

SETTINGS = json.dumps({"request": {"count": 3, "person": "ann"}})


def started(activity="collect", settings=SETTINGS):
    return RunStarted(0.0, "run", "pot", "circle15", "grid", 7, 1, True, settings,
                      activity=activity)  # fmt: skip


def collected(uuids, refused=""):
    facts = [started(), CampaignBegan(0.1, "c1", "series", "data", 0, 3), Gripped(1.0, 1, 1, 80.0),
             OriginChecked(1.5, (0.1, -0.2), 0.05, agrees=False)]  # fmt: skip
    for k, uuid in enumerate(uuids):
        why = refused if k == len(uuids) - 1 else ""
        facts.append(ProbeCollected(2.0 + k, uuid, k, 1, k + 1 - bool(why), 3, (0.0, 0.0),
                                    (1.5, -0.5 * k), 0.1, (0.0,) * 5, 0.0, 0.0, why))  # fmt: skip
    facts += [EpisodeDecided(9.0, uuids[0], 0, "flag", "ann"), Said(9.5, "The piece slipped."),
              RunFinished(10.0, "run", "cancelled", "by the operator")]  # fmt: skip
    return facts


def test_a_collection_tells_plan_person_and_progress():
    seen = collected_run(collected(["a", "b", "c"], refused="slip"))
    assert seen.headline == "2 of 3 probes"
    assert seen.facts().splitlines() == [
        "pot on circle15",
        "plan: grid, 3 probes, seed 7",
        "collected by ann",
        "3 probes in this run, 1 refused, 1 flag",
        "1 grip on 1 mounting",
        "Run cancelled. by the operator",
    ]
    lines = seen.lines()
    assert lines[0].startswith("1.  flag, ")
    assert lines[1].startswith("2.  kept, ")
    assert lines[2].startswith("3.  refused, ")
    assert "The piece slipped." in seen.told
    assert any(line.startswith("The origin does not agree") for line in seen.told)
    assert "Probe 2 of 3: refused, slip" in seen.told


def test_other_runs_are_no_collections():
    assert collected_run([started("stack")]) is None
    assert collected_run([]) is None
    assert collected_run([started(settings="no JSON")]).facts().count("?") == 1


@pytest.fixture
def filled(isolated_settings):
    """A dataset with three episodes of one campaign, and the plan of it."""
    folder, catalogue = isolated_settings / "data" / "dataset", load_pieces()
    with Dataset.open(folder, person="ann") as dataset:
        campaign = new_campaign("pot", "circle15", "grid", 7, 3, None)
        campaign.save(folder)
        pair = dataset.geometry.store_pair(catalogue.piece("pot"), catalogue.piece("circle15"))
        context = EpisodeContext("series", "circle15", pair, "ann", "g", "m",
                                 campaign=campaign.uuid, mode="stepped")  # fmt: skip
        for seed in range(3):
            dataset.record(make_episode(seed), Label(500 * seed, 0, 0, 300), source="measured",
                           context=context)  # fmt: skip
        yield dataset


def test_a_series_tells_what_is_known_of_it(filled):
    (series,) = list_series(filled)
    assert series.facts.splitlines() == [
        "pot on circle15, stepped",
        "plan: grid, 3 probes, seed 7",
        "recorded by ann",
        "3 draft; 0 refused",
        "1 grip on 1 mounting",
    ]


def test_the_probes_of_a_collection_are_shown(main, qtbot, tmp_path, filled):
    uuids = [entry.uuid for entry in filled.episodes()]
    journal = EventLog(tmp_path / "runs" / "20261121-041511-703")
    for fact in collected(uuids):
        journal(fact)
    main.go("review")
    workspace = main.workspaces["review"]
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    page = workspace.page
    page.runs.setCurrentIndex(page.runs.model().index(0, 0))
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    assert page.trials_panel.accessibleName() == "Probes"
    assert page.trials.count() == 3
    assert workspace.presenter.file == filled.path(uuids[2])
    assert page.story.item(page.story.count() - 1).text().startswith("Run cancelled")
    page.trials.setCurrentRow(0)
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    assert workspace.presenter.file == filled.path(uuids[0])
    assert "frame" in page.film.notes["left"].text()
    workspace._table()
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    (table,) = (tmp_path / "exports").glob("*.csv")
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert [(row["trial"], row["episode"]) for row in rows] == [
        (str(n), uuid) for n, uuid in enumerate(uuids, start=1)
    ]
    assert [float(row["x_mm"]) for row in rows] == [0.0, 0.5, 1.0]
