"""What concerns many episodes: bulk changes, agreement, the log, scores, a second copy."""

import json
import re
import shutil
from dataclasses import replace

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest

from tests.app.label.conftest import CTRL, ITEMS, KEY, SHIFT, WITHOUT_LABEL, make_episode
from tests.app.label.test_values import content
from tests.backend.annotations.filling import fill
from touchdown.app.label.session import AnnotationSession, QueueEntries, read_queue
from touchdown.app.label.side import agreement_figures
from touchdown.app.label.text import basis_text
from touchdown.app.shell.label_items import LabelDraft
from touchdown.backend.annotations import Dataset, EpisodeContext, Label
from touchdown.backend.core.values import EpisodeQuality
from touchdown.backend.placement import OffsetFit
from touchdown.widgets.lists.recordings import RowsOnDemand

LABELLED = ITEMS - WITHOUT_LABEL


def wait(desk, qtbot, text):
    qtbot.waitUntil(lambda: text in desk.page.message.text(), timeout=60_000)
    desk.settle()


def test_a_bulk_change_is_refused_if_a_label_changed_since(desk):
    form, uuid = desk.page.bulk, desk.uuid
    form.value.setText("1,1")
    form.preview.click()
    desk.settle()
    desk.book.set("Ann", uuid, Label(1, 1, 0, 100))
    before = content(desk)
    form.apply.click()
    desk.settle()
    assert "changed since the preview" in desk.page.message.text()
    assert content(desk) == before


@pytest.mark.parametrize(("kind", "text"), [(0, "1"), (1, "right"), (5, "")])
def test_a_bulk_change_that_makes_no_sense_has_no_preview(desk, kind, text):
    form = desk.page.bulk
    form.kind.setCurrentIndex(kind)
    form.value.setText(text)
    form.preview.click()
    desk.settle()
    assert not form.apply.isEnabled()
    assert "such as" in form.found.text() or "needs a reason" in form.found.text()


def test_opinions_measure_agreement_and_change_no_label(desk, monkeypatch):
    uuids = desk.workspace.presenter.walk.order[:3]
    for _ in uuids:
        desk.do(KEY.Key_Right, KEY.Key_Return)
    before = content(desk)
    desk.enter_as("Bob")
    desk.do((KEY.Key_B, CTRL))
    desk.workspace.session.queue = "audit"
    presenter = desk.workspace.presenter
    presenter.walk.begin(list(uuids), presenter.walk.entries, "")
    presenter.go_to(0)
    desk.settle()
    for uuid in uuids:
        assert not desk.now.edit.label.is_set  # nothing to be swayed by
        assert desk.page.side.history.list.count() == 0
        label = desk.book.head(uuid).label
        desk.type(f"{(label.x_um - 100) / 1000},{(label.y_um + 200) / 1000}")
        desk.do(KEY.Key_Return, KEY.Key_Return)
    assert content(desk) == before
    words, _ = agreement_figures(desk.workspace.presenter.dataset)
    assert "Ann minus Bob, 3 episodes" in words
    assert "x: bias +0.10 mm" in words
    assert "y: bias \N{MINUS SIGN}0.20 mm" in words
    assert re.search(r"RMS 0\.22 mm, patch IoU \d\d %", words)
    side, compare = desk.page.side, Dataset.compare
    periods = ("2026-11-25", 2, 0.5), ("2026-11-26", 1, 0.3)
    monkeypatch.setattr(Dataset, "compare", lambda *a: replace(compare(*a), periods=periods))
    assert side.over_time.isHidden()
    desk.do(KEY.Key_E)
    assert "2. 2026-11-26: 0.30 mm of 1" in side.agreement.text()
    (line,) = side.over_time.lines
    assert (line.name, line.points) == ("Ann, Bob", ((1, 0.5), (2, 0.3)))
    assert side.over_time.isVisible()


def test_the_model_scores_the_dataset_beside_the_labels(desk, qtbot):
    before = content(desk)
    desk.workspace.presenter.choose_queue("disagreement")
    desk.settle()
    assert "Ctrl+M" in desk.page.nothing.button.text()
    desk.press(KEY.Key_M, CTRL)
    wait(desk, qtbot, "has scored")
    qtbot.waitUntil(lambda: len(desk.workspace.presenter.walk.order) == LABELLED, timeout=60_000)
    assert content(desk) == before


def test_a_copy_labelled_elsewhere_is_merged_and_conflicts_are_resolved(desk, qtbot, tmp_path):
    presenter = desk.workspace.presenter
    uuid, other_uuid = presenter.walk.order[:2]
    other = tmp_path / "copy"
    shutil.copytree(presenter.dataset.folder, other)
    with Dataset.open(other, person="Bob") as copy:
        copy.labels.accept("Bob", uuid, Label(1, 2, 0, 100))
        copy.labels.accept("Bob", other_uuid)
    desk.type("3,3")
    desk.do(KEY.Key_Return)
    desk.workspace.tools.tasks.merge()
    desk.page.words.setText(str(other))
    desk.press(KEY.Key_Return)
    wait(desk, qtbot, "1 conflict")
    assert desk.book.head(other_uuid).person == "Bob"
    presenter.choose_queue("conflicts")
    desk.settle()
    assert desk.uuid == uuid
    desk.do(KEY.Key_C)
    assert desk.page.choice.isVisible()
    desk.do(KEY.Key_1)
    assert len(desk.book.conflicting(uuid)) == 1


def test_what_is_no_copy_is_refused(desk, qtbot, tmp_path):
    desk.workspace.tools.tasks.merge()
    desk.page.words.setText(str(tmp_path / "nowhere"))
    desk.press(KEY.Key_Return)
    wait(desk, qtbot, "nowhere")


def show_queue(desk, name):
    desk.workspace.presenter.choose_queue(name)
    desk.settle()


def go_to_unlabelled(desk):
    """Go to the first episode that has no displacement."""
    desk.workspace.presenter.go_to(ITEMS - WITHOUT_LABEL)
    desk.settle()
    assert not desk.now.edit.label.is_set


def test_another_person_reviews(desk):
    first, second = desk.workspace.presenter.walk.order[:2]
    desk.do(KEY.Key_Return, KEY.Key_Return)
    show_queue(desk, "review")
    assert desk.workspace.presenter.walk.order == []  # nobody reviews what they wrote
    desk.enter_as("Bob")
    assert desk.page.person.text() == "Bob"
    assert desk.workspace.presenter.walk.order == [first, second]
    desk.do(KEY.Key_Return)
    assert desk.book.head(first).state == "approved"
    assert desk.book.head(first).person == "Bob"
    desk.do(KEY.Key_U)
    assert desk.book.head(first).state == "submitted"
    desk.do(KEY.Key_Return)
    assert desk.book.head(first).state == "approved"
    desk.do(KEY.Key_D, KEY.Key_3)
    assert (desk.book.head(second).state, desk.book.head(second).reason) == (
        "rejected", "wrong piece",
    )  # fmt: skip
    desk.enter_as("Ann")
    show_queue(desk, "returned")
    assert desk.workspace.presenter.walk.order == [second]


def test_another_person_begins_with_the_first_of_the_queue(desk):
    desk.do(KEY.Key_Return, KEY.Key_Return)
    desk.enter_as("Bob")
    show_queue(desk, "review")
    first, second = desk.workspace.presenter.walk.order
    desk.do(KEY.Key_PageDown)
    assert desk.uuid == second
    desk.do((KEY.Key_R, CTRL))
    assert desk.uuid == second  # the same queue, read anew
    desk.enter_as("Cleo")
    assert desk.uuid == first
    desk.do(KEY.Key_PageDown)
    show_queue(desk, "coverage")
    assert desk.uuid == desk.workspace.presenter.walk.order[0]


def test_the_models_displacement_is_accepted_by_one_key_but_not_approved(desk):
    go_to_unlabelled(desk)
    uuid, model = desk.uuid, desk.now.item.model
    assert model is not None
    desk.do(KEY.Key_Return)
    head = desk.book.head(uuid)
    assert (head.source, head.state) == (model.source, "submitted")
    assert head.label.offset_mm == pytest.approx(model.fit.offset_mm, abs=0.001)
    assert head.label.sigma_um == round(1e3 * model.fit.sigma_mm)
    assert len(model.weights) == 64


def test_blind_nobody_sees_nor_takes_the_model(desk):
    walk = desk.workspace.presenter.walk
    walk.note(walk.order[3], ("model 9.0 \N{GREEK SMALL LETTER SIGMA} off",))
    assert desk.page.list.rows()[3].badges
    desk.do((KEY.Key_B, CTRL))
    go_to_unlabelled(desk)
    uuid = desk.uuid
    assert desk.page.view.scene.ghosts == ()
    assert "hidden" in desk.page.model_line.text()
    rows = desk.page.list.rows()
    assert not any("model" in badge for row in rows for badge in row.badges)
    desk.do(KEY.Key_M, KEY.Key_Return)
    assert desk.book.head(uuid).state == "unlabelled"
    assert "No displacement yet: type" in desk.page.message.text()
    desk.do(KEY.Key_H, KEY.Key_H)  # blind mode is not lifted by showing
    assert desk.page.view.scene.ghosts == ()
    assert desk.page.verdict.text() == "No displacement yet"
    desk.do(KEY.Key_Right)
    assert desk.book.head(uuid).label == Label(100, 0, 0, 200)


def test_blind_and_time_are_kept_with_the_answer(desk):
    desk.do((KEY.Key_B, CTRL), KEY.Key_Return)
    body = desk.book.log(limit=1)[0].body
    assert body["blind"] is True
    assert 0 <= body["seen_ms"] < 3_600_000


def test_taking_the_model_keeps_its_name_until_a_person_moves_it(desk):
    uuid = desk.uuid
    desk.do(KEY.Key_M)
    head = desk.book.head(uuid)
    assert head.source.startswith("model:")
    desk.do(KEY.Key_Right)
    head = desk.book.head(uuid)
    assert (head.source, head.label.sigma_um) == ("human", 200)


def test_the_page_says_what_a_label_rests_on(desk):
    takes = r"Accept takes this position, x \S+, y \S+ mm: "
    # The model is notably off.
    differ = r"The sources differ: drag the outline to the true place, or accept x \S+, y \S+ mm: "
    assert re.fullmatch(f"{differ}commanded, sigma\xa00.30\xa0mm", desk.page.basis.text())
    desk.do(KEY.Key_Right)
    assert re.fullmatch(f"{takes}set by Ann, sigma\xa00.20\xa0mm", desk.page.basis.text())
    uuid = desk.uuid
    desk.do(KEY.Key_Return)
    head = desk.book.head(uuid)
    edit, blank = LabelDraft.of(head), LabelDraft.blank(head)
    assert basis_text(edit, None, "").startswith("x ")
    assert basis_text(edit, None, "approve").startswith("Approve takes this position, x ")
    assert basis_text(edit, None, "accept", False).startswith("The sources agree: accept x ")
    model = OffsetFit((1.0, 2.0), 0.5)
    assert "takes the displacement of the model, x +1.00" in basis_text(blank, model, "accept")
    assert basis_text(blank, model, "") == basis_text(blank, None, "accept")
    assert [g.kind for g in desk.page.view.scene.ghosts] == ["commanded", "model"]


def test_a_far_model_is_badged(desk):
    desk.now.edit = desk.now.edit.placed(40.0, 40.0).trusted(0.1)
    desk.workspace.presenter.show_edit()
    assert any(badge.startswith("model") for badge in desk.page.strip.badges)
    assert desk.page.strip.warns


def test_a_damaged_file_costs_one_episode(start, folder):
    files = sorted((folder / "raw").rglob("*.mcap")) or sorted(folder.rglob("*.mcap"))
    data = bytearray(files[1].read_bytes())
    data[len(data) // 2] ^= 0xFF
    files[1].write_bytes(bytes(data))
    desk = start()
    desk.workspace.presenter.go_to(1)
    desk.settle()
    assert desk.now is None
    assert "cannot be read" in desk.page.nothing.title.text()
    assert "damaged" in desk.page.message.text()
    uuid, walk = desk.workspace.presenter.walk.uuid, desk.workspace.presenter.walk
    for key in (KEY.Key_PageDown, KEY.Key_Return):
        desk.workspace.presenter.go_to(1)
        desk.settle()
        desk.do(key)
        assert (desk.now is not None, walk.at) == (True, 2)
    assert desk.book.head(uuid).state == "draft"


def test_no_probe_keeps_the_annotator(start, folder):
    with Dataset.open(folder, person="setup") as dataset:
        known = dataset.episodes()[0]
        context = EpisodeContext("series", "circle15", known.geometry, "setup", "g1", "m1")
        lost = EpisodeQuality(False, ("The left camera has no frame.",), 1, 0.0, 0, 5.0, 0.01)
        for seed, label in (
            (90, Label(100, 200, 0, 300)),
            (91, Label()),
            (92, Label(1, 2, 0, 300)),
        ):
            episode = replace(make_episode(seed), quality=lost)
            dataset.record(episode, label, source="commanded", context=context)
    desk = start()
    desk.workspace.session.hidden = True
    desk.do(KEY.Key_End, KEY.Key_PageUp, KEY.Key_PageUp)
    refused, empty, last = desk.workspace.presenter.walk.order[-3:]
    desk.do(KEY.Key_Return)
    assert desk.book.head(refused).state == "submitted"
    desk.do(KEY.Key_Return)
    assert desk.uuid == empty
    assert "PgDown skips, D rejects" in desk.page.message.text()
    desk.do(KEY.Key_PageDown, KEY.Key_Return)
    assert desk.book.head(last).state == "submitted"
    assert desk.book.head(empty).state == "unlabelled"


def test_what_is_remembered_is_checked(start):
    desk = start()
    dropped = desk.workspace.recall({"person": 7, "queue": "x", "sigma_mm": -1.0, "blind": "no"})
    assert sorted(dropped) == ["blind", "person", "queue", "sigma_mm"]
    assert desk.workspace.memory()["person"] == "Ann"
    assert desk.workspace.recall({"queue": "uncertainty"}) == []
    assert desk.workspace.session.queue == "training"  # its name since then


def test_a_second_window_looks_but_does_not_write(start, folder):
    with Dataset.open(folder, person="Zoe"):
        desk = start()
        uuid = desk.uuid
        desk.do(KEY.Key_Return)
        assert "reading only" in desk.page.message.text()
        assert desk.book.head(uuid).state == "draft"


def test_the_label_moves_every_view_to_one_instant(desk):
    desk.do(KEY.Key_BracketLeft)
    t_s = desk.page.film.cursor_s
    assert desk.page.forces.cursor_s == desk.page.moments.cursor_s == t_s
    assert desk.now.item.span_s[0] <= t_s < 2.0


def test_gold_looks_like_the_rest_of_a_blind_audit_and_a_verdict_there_changes_no_label(desk):
    presenter, order = desk.workspace.presenter, desk.workspace.presenter.walk.order
    gold, other = order[:2]
    for uuid in (gold, other):
        desk.book.accept("Bob", uuid)
    desk.book.approve("Cleo", gold)
    desk.book.flag("Cleo", gold)
    heads = {uuid: desk.book.head(uuid) for uuid in (gold, other)}
    desk.workspace.session.queue = "audit"
    desk.do((KEY.Key_B, CTRL))  # from here on answers are opinions
    entries = QueueEntries(presenter.dataset, [gold, other], 2)
    presenter.walk.begin([gold, other], entries, "")
    presenter.go_to(0)
    desk.settle()
    page, seen = desk.page, []
    for uuid in (gold, other):
        assert desk.uuid == uuid
        row = page.list.rows()[presenter.walk.at]
        seen.append((
            row.state, row.badges, page.strip.state, page.strip.badges, page.strip.saved,
            page.basis.text(), page.message.text(), page.side.history.list.count(),
        ))  # fmt: skip
        desk.do(KEY.Key_V, KEY.Key_S)
        assert "says stable" in page.strip.badges
        desk.type("1,2")
        desk.do(KEY.Key_Return, KEY.Key_Return)
    assert seen[0] == seen[1]
    assert [row.badges for row in page.list.rows()] == [("answered",)] * 2
    assert {uuid: desk.book.head(uuid) for uuid in heads} == heads
    kept = desk.workspace.presenter.dataset.labels.log(text="Ann", limit=2)
    assert [o.body["opinions"][0]["verdict"] for o in kept] == ["stable", "stable"]


def test_gold_among_the_ordinary_queue_cannot_be_told_and_keeps_its_label(desk, monkeypatch):
    presenter = desk.workspace.presenter
    gold = presenter.walk.order[:2]
    for uuid in gold:
        desk.book.accept("Bob", uuid, Label(1500, 0, 0, 50))
        desk.book.approve("Cleo", uuid)
    heads = {uuid: desk.book.head(uuid) for uuid in gold}
    monkeypatch.setattr("touchdown.backend.annotations.queues.AUDIT_SHARE", 1.0)
    desk.do((KEY.Key_R, CTRL))
    order, rows = presenter.walk.order, desk.page.list.rows()
    places = {uuid: order.index(uuid) for uuid in gold}
    assert sorted(place // 20 for place in places.values()) == [0, 1]
    assert {row.state for row in rows[: ITEMS - 2 * WITHOUT_LABEL]} == {"draft"}
    seen = []
    for uuid in (*gold, next(u for u in order if u not in gold)):
        presenter.go_to(order.index(uuid))
        desk.settle()
        assert desk.uuid == uuid
        page, at = desk.page, presenter.walk.at
        rests_on = page.basis.text().rpartition(": ")[2]
        versions = page.side.history.list.count()
        shown = page.strip.state, page.message.text(), versions, rests_on
        desk.do(KEY.Key_Right, KEY.Key_Return)
        seen.append((shown, page.list.rows()[at].state))
        desk.do(KEY.Key_U)
        assert presenter.walk.at == at
        desk.do(KEY.Key_Return)
    assert seen[0] == seen[1] == seen[2]
    assert {uuid: desk.book.head(uuid) for uuid in gold} == heads
    assert "Ann on gold minus approved label, 2 episodes" in agreement_figures(presenter.dataset)[0]
    desk.do((KEY.Key_R, CTRL))
    assert not set(gold) & set(presenter.walk.order)


def test_entries_and_rows_of_a_large_queue_are_read_in_pages(tmp_path) -> None:
    with Dataset.open(tmp_path / "large") as dataset:
        uuids = fill(dataset, 950)
        session = AnnotationSession(person="zoe", queue="unlabelled")
        order, entries, gold = read_queue(dataset, session)
        assert (order, entries.total, len(entries), gold) == (uuids, 950, 0, {})
        rows = RowsOnDemand(len(order), lambda at: entries[order[at]])
        assert rows[-1].uuid == uuids[-1]
        assert len(entries) == 150
        assert [row.uuid for row in rows] == order
        assert dict(entries) == {entry.uuid: entry for entry in dataset.episodes()}


def type_filter(desk, text):
    desk.do((KEY.Key_F, CTRL))
    assert desk.page.filter.hasFocus()
    desk.page.filter.setText(text)
    desk.press(KEY.Key_Return)
    desk.settle()


def test_all_episodes_are_a_queue_with_a_filter_that_a_kill_cannot_lose(desk, tmp_path):
    presenter, page, session = desk.workspace.presenter, desk.page, desk.workspace.session
    kept = presenter.walk.order[3]
    desk.book.set("Ann", kept, Label(1500, -200, 0, 100), note="bent corner")
    assert page.filter.isHidden()
    desk.press(KEY.Key_S, CTRL)
    assert "type one first (Ctrl+F)" in page.message.text()
    type_filter(desk, "colour:red")
    assert "'colour:red' is no filter. Use words, and piece:" in page.message.text()
    type_filter(desk, "corner state:draft")
    assert (presenter.walk.order, desk.uuid) == ([kept], kept)
    for name, said in (("gold", "cannot have the name"), ("Corners", "")):
        desk.press(KEY.Key_S, CTRL)
        page.words.setText(name)
        desk.press(KEY.Key_Return)
        desk.settle()
        assert said in page.message.text()
    assert (page.queue.currentText(), page.keep_filter.text()) == ("Corners", "Forget")
    # Stored with the last key: nothing is left to write when the program is killed.
    stored = json.loads((tmp_path / "window.json").read_text())["pages"]["collect"]
    assert (stored["queue"], stored["saved"]) == ("Corners", {"Corners": "corner state:draft"})
    session.saved.clear()
    assert desk.workspace.recall(stored) == []
    assert session.wanted == "corner state:draft"
    type_filter(desk, "bottom:hex20")
    assert page.nothing.title.text() == "No episode passes the filter"
    presenter.choose_queue("Corners")
    desk.settle()
    assert presenter.walk.order == [kept]
    page.keep_filter.click()
    desk.settle()
    assert (session.queue, session.saved, page.queue.findData("Corners")) == ("all", {}, -1)
    assert presenter.walk.order == [kept], "the list stays as it was"


def test_a_bulk_change_takes_the_selected_labels_alone(desk):
    page, order = desk.page, desk.workspace.presenter.walk.order
    desk.do((KEY.Key_PageDown, SHIFT), (KEY.Key_PageDown, SHIFT), (KEY.Key_PageUp, SHIFT))
    assert page.queue_panel.detail.text() == f"1 of {len(order)}, 2 selected"
    desk.do(KEY.Key_B)
    assert "Change the 2 selected labels how?" in page.choice._title.text()
    desk.do(KEY.Key_Escape)
    place = page.list.visualRect(page.list.index_of(3)).center()
    QTest.mouseClick(page.list.viewport(), Qt.MouseButton.LeftButton, CTRL, place)
    assert page.list.selected() == [0, 1, 3]
    assert desk.uuid == order[0], "a click with Ctrl goes nowhere"
    page.bulk.kind.setCurrentIndex(page.bulk.kind.findData("accept"))
    page.bulk.preview.click()
    desk.settle()
    assert "3 labels will change" in page.bulk.found.text()
    page.bulk.apply.click()
    desk.settle()
    states = [desk.book.head(uuid).state for uuid in order]
    assert [at for at, state in enumerate(states) if state == "submitted"] == [0, 1, 3]


def test_the_model_stands_beside_the_label_where_a_queue_is_about_a_score(desk):
    presenter, page = desk.workspace.presenter, desk.page
    first, second = presenter.walk.order[:2]
    desk.book.set("Ann", first, Label(1500, -200, 0, 100))
    presenter.dataset.scores.put("disagreement", {first: 2.5, second: 7.0}, "m")
    presenter.dataset.scores.suggest({first: Label(1000, 300, 0, 300)}, "m")
    presenter.choose_queue("disagreement")
    desk.settle()
    assert presenter.walk.order == [second, first]
    minus = "\N{MINUS SIGN}"
    assert page.list.rows()[1].badges[0] == f"2.5: +1.50, {minus}0.20; model +1.00, +0.30"
    presenter.go_to(1)
    desk.settle()
    desk.do(KEY.Key_Right)
    assert page.list.rows()[1].badges[0].startswith("+1.60, ")
    desk.do(KEY.Key_H)
    assert not any("model" in word for word in page.list.rows()[1].badges), "hidden with the rest"


def test_the_end_of_a_queue_says_what_it_gave_and_offers_the_next_one(desk):
    presenter, step = desk.workspace.presenter, desk.main.window.next_step
    submitted = presenter.walk.order[:2]
    for uuid in submitted:
        desk.book.accept("Bob", uuid, Label(1, 1, 0, 100))
    presenter.choose_queue("review")
    desk.settle()
    assert step.isHidden()
    desk.do(KEY.Key_Return, KEY.Key_Return)
    left = ITEMS - 2
    text = f"Waiting for review: 2 episodes done. Unlabelled and drafts: {left} episodes."
    assert (step.text.text(), step.yes.text()) == (text, "Open that queue")
    assert step.text.width() >= step.text.fontMetrics().horizontalAdvance("Waiting for review: 2")
    desk.do((KEY.Key_Period, CTRL))
    desk.settle()
    assert step.isHidden()
    # An approved label can come back among them as a control item: its draw depends on the id.
    waiting = [uuid for uuid in presenter.walk.order if uuid not in submitted]
    assert (desk.workspace.session.queue, len(waiting)) == ("unlabelled", left)


def test_a_training_is_offered_after_some_labels_of_the_queue_for_it(desk, monkeypatch):
    monkeypatch.setattr("touchdown.app.label.presenter.RETRAIN_EVERY", 2)
    presenter, step = desk.workspace.presenter, desk.main.window.next_step
    order = presenter.walk.order[3::-1]
    dataset = presenter.dataset
    dataset.scores.put("training", {uuid: 4.0 - k for k, uuid in enumerate(order)}, "m")
    presenter.choose_queue("training")
    desk.settle()
    assert presenter.walk.order == order
    desk.do(KEY.Key_Return)
    assert step.isHidden()
    desk.do(KEY.Key_Return)
    text = "Most to learn: 2 episodes done. 2 labels for a training."
    assert (step.text.text(), step.yes.text()) == (text, "Train on them")
    assert desk.uuid == order[2]
    desk.do((KEY.Key_Period, CTRL))
    assert desk.main.window.front == "train"


def test_a_correction_goes_to_the_whole_grip_by_one_key_and_back(desk):
    presenter = desk.workspace.presenter
    dataset, uuid = presenter.dataset, desk.uuid
    arm = {entry.uuid: dataset.labels.head(entry.uuid).label for entry in dataset.episodes()}
    desk.do(KEY.Key_Right, KEY.Key_Right, KEY.Key_K)
    others = [one for one, label in arm.items() if label.is_set and one != uuid]
    assert len(others) == ITEMS - WITHOUT_LABEL - 1
    said = f"{len(others)} other probes of the grip moved by +0.20, +0.00 mm and accepted."
    assert desk.page.message.text().startswith(said)
    for one in (uuid, *others):
        head = dataset.labels.head(one)
        assert (head.state, head.label.x_um) == ("submitted", arm[one].x_um + 200)
    assert len(presenter.walk.order) == WITHOUT_LABEL
    desk.do(KEY.Key_U)
    heads = [dataset.labels.head(one) for one in (uuid, *others)]
    assert [head.state for head in heads] == ["submitted", *len(others) * ["draft"]]
    assert [head.label for head in heads[1:]] == [arm[one] for one in others]


def test_a_control_item_corrects_its_grip_by_the_answer_and_keeps_its_label(desk, monkeypatch):
    presenter = desk.workspace.presenter
    gold, other = presenter.walk.order[:2]
    arm = desk.book.head(gold).label
    desk.book.accept("Bob", gold, Label(1500, 0, 0, 50))
    desk.book.approve("Cleo", gold)
    before, drafted = desk.book.head(gold), desk.book.head(other).label
    monkeypatch.setattr("touchdown.backend.annotations.queues.AUDIT_SHARE", 1.0)
    desk.do((KEY.Key_R, CTRL))
    presenter.go_to(presenter.walk.order.index(gold))
    desk.settle()
    desk.type(f"{arm.x_um / 1e3 + 0.4},{arm.y_um / 1e3}")
    desk.do(KEY.Key_Return, KEY.Key_K)
    assert desk.book.head(gold) == before
    head = desk.book.head(other)
    assert (head.label.x_um - drafted.x_um, head.state) == (400, "submitted")


def test_a_training_is_offered_after_labels_that_corrected_their_grips(desk, monkeypatch):
    monkeypatch.setattr("touchdown.app.label.presenter.RETRAIN_EVERY", 2)
    presenter, step = desk.workspace.presenter, desk.main.window.next_step
    dataset = presenter.dataset
    pair = dataset.entry(desk.uuid).geometry
    order = []
    for k in range(6):
        grip = EpisodeContext("series", "circle15", pair, "setup", f"m/grip-{k // 2}", "m")
        order.append(dataset.record(make_episode(90 + k), Label(k, 0, 0, 300),
                                    source="measured", context=grip).uuid)  # fmt: skip
    dataset.scores.put("training", {uuid: -float(k) for k, uuid in enumerate(order[::2])}, "m")
    presenter.choose_queue("training")
    desk.settle()
    assert presenter.walk.order == order[::2]
    desk.do(KEY.Key_K)
    assert step.isHidden()
    assert desk.page.message.text().startswith("1 other probe of the grip moved by +0.00, +0.00")
    desk.do(KEY.Key_K)
    assert step.text.text() == "Most to learn: 2 episodes done. 2 labels for a training."
    assert desk.uuid == order[4]
    assert [dataset.labels.head(uuid).state for uuid in order] == [
        *4 * ["submitted"],
        *2 * ["draft"],
    ]


def test_no_correction_is_carried_while_reviewing(desk):
    presenter = desk.workspace.presenter
    presenter.dataset.labels.accept("Bob", desk.uuid)
    presenter.choose_queue("review")
    desk.settle()
    desk.do(KEY.Key_K)
    assert "only while labelling" in desk.page.message.text()
    assert presenter.dataset.labels.head(desk.uuid).state == "submitted"
