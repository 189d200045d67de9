"""The judge of the fault campaign on made-up strikes, its plan, its table and its files."""

import re
from collections import defaultdict
from dataclasses import replace
from math import inf

import numpy as np
import pytest

from tests.bench import campaign
from tests.bench.campaign import ACTIVITIES, CHECKS, Ending, Seen, endings, judge, rendered
from touchdown.backend.bench.emulated_scene import command_travel
from touchdown.backend.core import Fault

RULE = Ending("S6", ("a:b",), ("FT-STALE",), 0.6, "retreat", True, ("sensor",))
GOOD = Seen(
    "FT-STALE", 0.4, ("The wrist sensor is silent.", "The arm is held.", "Look at it."), 0,
    (0.1, 0.0, 2.0), (), ended=True, struck=True,
)  # fmt: skip
BROKEN = {
    "another fault": (replace(GOOD, code="CAMERA-STALE"), "documented"),
    "no fault": (Seen(), "documented"),
    "goes on for ever": (replace(GOOD, ended=False), "documented"),
    "never struck": (replace(GOOD, struck=False), "documented"),
    "late": (replace(GOOD, after_s=0.61), "in time"),
    "jaws opened": (replace(GOOD, openings=1), "jaws"),
    "moved sideways": (replace(GOOD, travel_mm=(0.6, 0.0, 0.0)), "arm"),
    "moved down": (replace(GOOD, travel_mm=(0.0, 0.2, 0.0)), "arm"),
    "rose too far": (replace(GOOD, travel_mm=(0.0, 0.0, 3.0)), "arm"),
    "an episode is lost": (replace(GOOD, lost=("InputError: damaged",)), "data"),
    "device not named": (replace(GOOD, message=("It is silent.", "Held.", "Look.")), "message"),
    "no next step": (replace(GOOD, message=("The sensor is silent.", "Held.", " ")), "message"),
    "internal name": (replace(GOOD, message=("Sensor force_torque.", "Held.", "x")), "message"),
    "position of a byte": (replace(GOOD, message=("Sensor, byte 28.", "Held.", "x")), "message"),
    "class of an error": (replace(GOOD, message=("Sensor: KeyError.", "Held.", "x")), "message"),
}


def broken(rule: Ending, seen: Seen, load: tuple[str, ...] = ()) -> list[str]:
    return [name for name, holds in judge(rule, seen, load).items() if not holds]


def test_a_strike_as_documented_breaks_nothing() -> None:
    assert tuple(judge(RULE, GOOD)) == CHECKS
    assert broken(RULE, GOOD) == []
    assert broken(replace(RULE, then="stand"), GOOD) == ["arm"], "an arm that stands stays"
    assert broken(replace(RULE, must=False), Seen()) == []
    assert broken(replace(RULE, then="lift"), replace(GOOD, travel_mm=(0.0, 0.0, 50.0))) == []
    in_a_file = ("The sensor log /some_where/a_place/x cannot be written.", "Held.", "Look.")
    assert broken(RULE, replace(GOOD, message=in_a_file)) == []


@pytest.mark.parametrize("name", BROKEN)
def test_each_rule_can_be_broken_alone(name: str) -> None:
    seen, check = BROKEN[name]
    assert broken(RULE, seen) == [check]


def test_a_fault_of_a_busy_computer_is_documented_but_may_not_move_the_arm() -> None:
    late = replace(GOOD, code="LEASE-LAPSED", after_s=3.0, message=("Late.", "Held.", "Again."))
    assert broken(RULE, late, ("LEASE-LAPSED",)) == []
    moved = replace(late, travel_mm=(0.0, 1.0, 0.0))
    assert broken(RULE, moved, ("LEASE-LAPSED",)) == ["arm"]


def test_the_travel_of_commands_counts_from_the_report_on() -> None:
    ways = [(0.0, 0.0, 9.0), (5.0, 0.0, 3.0), (5.0, 0.3, 2.5), (5.4, 0.0, 4.0)]
    commands = [(float(k), np.array(way)) for k, way in enumerate(ways)]
    assert command_travel(commands, 1.0) == pytest.approx((0.4, 0.5, 1.0))
    assert command_travel(commands, inf) == (0.0, 0.0, 0.0)


def test_every_kind_strikes_in_every_activity_and_has_one_allowed_ending() -> None:
    rules, _ = endings()
    struck = defaultdict(set)
    for _, bench, kind, activity in campaign.plan():
        struck[bench, kind].add(activity)
    assert {kind for _, kind in struck} == set(rules)
    assert len(rules) >= 60
    assert len(campaign.plan()) >= 600
    whole = {key: done for key, done in struck.items() if "program" not in key[1]}
    assert all(done in (set(ACTIVITIES), {"streaming"}) for done in whole.values())


def test_the_page_shows_the_table_of_endings_and_the_stored_results() -> None:
    text = campaign.PAGE.read_text("utf-8")
    rows = {rule.row for rule in endings()[0].values()}
    assert rows <= set(re.findall(r"\b[A-Z]\d+\b", text.split("## Known gaps")[0]))
    assert rendered(text, campaign.stored()) == text


def test_results_belong_to_one_state_of_the_sources(tmp_path, monkeypatch) -> None:
    page = tmp_path / "faults.md"
    page.write_text(campaign.PAGE.read_text("utf-8"), "utf-8")
    monkeypatch.setattr(campaign, "RESULTS", tmp_path / "campaign.json")
    monkeypatch.setattr(campaign, "PAGE", page)
    row = campaign.run_strike(7, "simulated", "force_torque:stop", "collecting")
    assert (row["code"], row["broken"]) == ("FT-STALE", [])
    campaign.save([row], "abc")
    content = campaign.stored("abc")
    assert content is not None
    assert [one["number"] for one in content["strikes"]] == [7]
    assert campaign.stored("other") is None
    assert "1 strikes" in page.read_text("utf-8")


def test_stored_messages_name_no_temporary_folder() -> None:
    fault = Fault(
        "DISK-FULL", "Full.", "Stopped.", "Make room on the disk of /scratch/ab/runs/1.", ""
    )
    assert (
        campaign.stored_message(fault, "/scratch/ab")[2] == "Make room on the disk of DATA/runs/1."
    )


def test_a_jog_is_struck_while_it_goes_on():
    row = campaign.run_strike(67, "simulated", "force_torque:stop", "jogging")
    assert (row["code"], row["struck"], row["broken"]) == ("FT-STALE", True, [])
