"""``make bench``: exit code, choice of figures, and the stored results."""

import json
from types import SimpleNamespace

import pytest

from tests.bench import experiments, figures, laboratories, laboratory_labels, run, throughput
from tests.bench.figures import Figure, figure
from touchdown.backend.config import load_simulation
from touchdown.backend.core.faults import InputError
from touchdown.backend.simulation import mujoco_available


@pytest.fixture(autouse=True)
def empty(monkeypatch):
    monkeypatch.setattr(run, "MODULES", ())
    monkeypatch.setattr("tests.bench.figures.REGISTER", {})
    monkeypatch.setattr(run, "REGISTER", {})
    monkeypatch.setattr(run, "LONG", set())


def _register(monkeypatch, **measures):
    for name, measure in measures.items():
        monkeypatch.setitem(run.REGISTER, name, ("group " + name, measure))


def test_all_met_is_0_and_one_missed_is_1_and_all_are_shown(monkeypatch, capsys):
    _register(
        monkeypatch,
        a=lambda: [Figure("speed [ms]", 0.8214, "ms", "<= 1", True, "one thread")],
        b=lambda: [Figure("placed", "58 of 60", "", "stated", None)],
    )
    assert run.main([]) == 0
    shown = capsys.readouterr().out
    for word in ("speed [ms]", "0.8214 ms", "<= 1 ms", "met", "one thread", "58 of 60", "stated"):
        assert word in shown
    assert "2 figures, 0 missed" in shown
    _register(monkeypatch, a=lambda: [Figure("speed", 3.0, "ms", "<= 1", False)])
    assert run.main([]) == 1
    assert "missed" in capsys.readouterr().out


def test_a_figure_that_cannot_be_measured_is_missed_and_the_rest_goes_on(monkeypatch, capsys):
    def broken():
        raise InputError("No model ships.", "pot.safetensors", "make models")

    _register(monkeypatch, a=broken, b=lambda: [Figure("x", 1.0, "", "1", True)])
    assert run.main(["--json"]) == 1
    first, second = json.loads(capsys.readouterr().out)["figures"]
    assert (first["ok"], first["value"]) == (False, None)
    assert "make models" in first["note"]
    assert second["ok"]


@pytest.mark.parametrize("name", ["group b", "b"])
def test_groups_and_figures_are_chosen_by_name(name, monkeypatch, capsys):
    _register(
        monkeypatch,
        a=lambda: [Figure("first", 1.0, "", "", True)],
        b=lambda: [Figure("second", 1.0, "", "", True)],
    )
    assert run.main([name, "--json"]) == 0
    assert [f["name"] for f in json.loads(capsys.readouterr().out)["figures"]] == ["second"]


def test_long_measurements_run_by_name_only(monkeypatch, capsys):
    _register(
        monkeypatch,
        a=lambda: [Figure("first", 1.0, "", "", True)],
        b=lambda: [Figure("second", 1.0, "", "", True)],
    )
    run.LONG.add("b")
    for words, expected in (([], "first"), (["b"], "second"), (["group b"], "second")):
        assert run.main([*words, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)["figures"]
        assert [f["name"] for f in found] == [expected]
    assert run.main([]) == 0
    assert "Measured by name only: b." in capsys.readouterr().out


def test_an_interrupted_run_keeps_what_it_measured_and_goes_on(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(figures, "DATA", tmp_path / "measured.json")
    monkeypatch.setattr(figures, "PAGE", tmp_path / "measured.md")
    old = figures.records_of("group b", "b", [Figure("second", 1.0, "", "", True)])
    content = {"format": figures.FORMAT, "figures": old}  # without its time
    (tmp_path / "measured.json").write_text(json.dumps(content), "utf-8")
    (tmp_path / "measured.md").write_text("<!-- figures -->\n\n<!-- end -->", "utf-8")

    def interrupted():
        raise KeyboardInterrupt

    _register(monkeypatch, a=lambda: [Figure("first", 1.0, "", "", True)], b=interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.main(["--save"])
    today = figures.read_records()[0]["date"]
    _register(monkeypatch, a=interrupted, b=lambda: [Figure("second", 2.0, "", "", True)])
    assert run.main(["--save", "--since", today]) == 0
    assert [r["value"] for r in figures.read_records()] == [2.0, 1.0]
    assert run.main(["--save", "--since", today]) == 0
    with pytest.raises(KeyboardInterrupt):
        run.main(["--since", "2999-01-01"])


def test_two_figures_of_one_name_are_a_defect():
    def speed():
        return []

    figure("a")(speed)
    with pytest.raises(ValueError, match="speed"):
        figure("b")(speed)


def test_saved_figures_replace_those_of_their_function_and_the_page_shows_them(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(figures, "DATA", tmp_path / "measured.json")
    monkeypatch.setattr(figures, "PAGE", tmp_path / "measured.md")
    old = figures.records_of("group a", "a", [Figure("old", 1.0, "ms", "<= 2", True)])
    other = figures.records_of("group b", "b", [Figure("other", 7, "of 9", "stated", None)])
    content = {"format": figures.FORMAT, "figures": [*old, *other]}
    (tmp_path / "measured.json").write_text(json.dumps(content), "utf-8")
    (tmp_path / "measured.md").write_text("Top\n<!-- figures -->\n\n<!-- end -->\nEnd", "utf-8")
    _register(
        monkeypatch,
        a=lambda: [
            Figure("new", 3.0, "ms", "<= 2", False, "why"),
            Figure("no", None, "", "", None),
        ],
    )
    assert run.main(["a", "--save"]) == 1
    assert [record["figure"] for record in figures.read_records()] == ["new", "other"]
    page = (tmp_path / "measured.md").read_text("utf-8")
    assert "2 figures: 0 meet their target, 1 miss it, 1 have none." in page
    assert "| group a | new | 3 ms | ≤ 2 | why |" in page
    assert "| other | 7 of 9 |" in page
    # The old record of the other group has no time.
    assert page.count("Time of ") == page.count("Time of 1 of 1 measurements: 0.0 min.") == 1
    assert page.startswith("Top")
    assert page.endswith("End")
    figures.save([], ["other"])
    assert [record["figure"] for record in figures.read_records()] == ["new"]
    with pytest.raises(ValueError, match="there is no figure other"):
        figures.save([], ["other"])


def test_the_last_test_run_is_a_figure_unless_it_was_a_part(monkeypatch, tmp_path):
    report = tmp_path / "tests.xml"
    monkeypatch.setattr(throughput, "SUITE", report)
    monkeypatch.setattr(throughput.subprocess, "run", lambda *_, **__: SimpleNamespace(stdout="94"))
    with pytest.raises(InputError, match="no result of the tests"):
        throughput.last_test_run()
    line = '<testsuites><testsuite errors="0" failures="{}" skipped="5" tests="{}" time="{}"/>'
    for failed, seconds, ok in ((0, 543.2, True), (1, 543.2, False), (0, 600.0, False)):
        report.write_text(line.format(failed, 5792, seconds) + "</testsuites>", "utf-8")
        suite, coverage = throughput.last_test_run()
        assert suite.ok is ok
        assert suite.note.startswith(f"{5787 - failed:,} passed, {failed} failed")
        assert (coverage.value, coverage.unit) == (94, "%")
    assert suite.value == "10 min 0 s"
    report.write_text(line.format(0, 12, 3.0) + "</testsuites>", "utf-8")
    with pytest.raises(InputError, match="Only 12 tests"):
        throughput.last_test_run()


def test_a_laboratory_is_added_to_those_that_are_there(tmp_path, monkeypatch):
    monkeypatch.setattr(laboratories, "DATA", tmp_path / "measured.json")
    for seed, share in ((13, 1.0), (2, 2.0), (13, 3.0)):
        of = laboratories.with_result("hidden", {"seed": seed, "share": share, "bench": {}})
        laboratories.save_result("hidden", {"of": of})
    stored = laboratories.stored_results("hidden")
    assert stored == [{"seed": 2, "share": 2.0}, {"seed": 13, "share": 3.0}]


def test_labels_needed_are_read_where_random_order_ends():
    batch = laboratory_labels.BATCH
    # The mean ends at 0.6, reached after two batches.
    rising = [[0.3, 0.5, 0.6, 0.7], [0.3, 0.5, 0.6, 0.5]]
    found = laboratory_labels.labels_needed(
        [{"random": rising, "queue": [[0.3, 0.6, 0.65]] * 2}], "random"
    )
    assert found["labels"] == {"random": pytest.approx(2 * batch), "queue": pytest.approx(batch)}
    assert found["share"] == pytest.approx(0.5)
    low, high = found["interval"]
    assert low == pytest.approx(1 / 2)  # draws of the second seed twice end at 0.5, after a batch
    assert high is None or high >= 0.5
    never = {"random": [[0.3, 0.5, 0.6, 0.7]], "queue": [[0.3, 0.4, 0.5, 0.5]]}
    found = laboratory_labels.labels_needed([never], "random")
    assert (found["share"], found["interval"], found["draws_that_reach"]) == (None, [None] * 2, 0)
    both = [
        {"random": rising, "queue": rising},
        {"random": rising, "queue": [[0.3, 0.9, 1, 1]] * 2},
    ]
    found = laboratory_labels.labels_needed(both, "random")
    assert found["labels"]["queue"] == pytest.approx(2.5 * batch)
    assert found["share"] == pytest.approx(125 / 200)


def test_success_that_comes_back_counts_what_was_lost():
    own, before, after = (n * ["placed"] + (20 - n) * ["fell"] for n in (18, 8, 13))
    found = laboratories.recovered(own, before, after)
    assert found["lost_points"] == pytest.approx(50.0)
    assert found["comes_back"] == pytest.approx(0.5)
    low, high = found["interval"]
    assert 0.1 < low < 0.5 < high < 0.9
    assert found["unsafe_of_released"] == pytest.approx(7 / 20)
    assert laboratories.interval_by_laboratory([found]).tolist() == [100 * low, 100 * high]
    half = {"outcomes": {"own": {"placed": 10}, "before": {"fell": 10}, "after": {"placed": 5}}}
    whole = {"outcomes": half["outcomes"] | {"after": {"placed": 10}}}
    # Draws of the same laboratory twice are a quarter of the draws each.
    assert laboratories.interval_by_laboratory([half, whole]).tolist() == [50, 100]
    assert laboratories.interval_by_laboratory([half, half]).tolist() == [50, 50]


@pytest.mark.optional
@pytest.mark.skipif(not mujoco_available(), reason="needs the optional engine")
def test_presses_with_a_short_ramp_are_judged_by_all_frames(monkeypatch):
    pytest.importorskip("skfem")
    monkeypatch.setattr(experiments, "GEL_ELSEWHERE", (2, 1, 2))
    found = experiments.recorded_elsewhere(load_simulation(preset="bench-v1"), 1)
    assert [press.grip for press in found.presses] == ["g0", "g1"]
    for press in found.presses:
        assert press.signals.fields[-1].t_s > press.onset_s + press.probe.duration_s
