"""What concerns many episodes: bulk changes, agreement, the log, scores, a second copy."""

import shutil

import pytest

from tests.app.label.conftest import CTRL, ITEMS, KEY, WITHOUT_LABEL
from tests.app.label.test_saving import content
from touchdown.app.label.side import agreement_text
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label

LABELLED = ITEMS - WITHOUT_LABEL


def wait(desk, qtbot, text):
    qtbot.waitUntil(lambda: text in desk.page.message.text(), timeout=60_000)
    desk.settle()


def test_a_bulk_shift_is_previewed_applied_and_taken_back_in_one_step(desk):
    before, form = content(desk), desk.page.bulk
    form.value.setText("0.5,-0.25")
    form.preview.click()
    desk.settle()
    assert f"{LABELLED} labels will change." in form.found.text()
    assert f"{WITHOUT_LABEL} labels will not" in form.found.text()
    assert content(desk) == before
    form.apply.click()
    desk.settle()
    after = content(desk)
    moved = [u for u in before if after[u][0] != before[u][0]]
    assert len(moved) == LABELLED
    old, new = before[moved[0]], after[moved[0]]
    assert (new[0].x_um, new[0].y_um) == (old[0].x_um + 500, old[0].y_um - 250)
    assert new[1] == old[1] == "commanded"
    desk.do(KEY.Key_U)
    assert content(desk) == before


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


def test_opinions_measure_agreement_and_change_no_label(desk):
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
        if desk.page.choice.isVisible():  # Bob is asked once how sure he is
            desk.do(KEY.Key_Return)
    assert content(desk) == before
    words = agreement_text(desk.workspace.presenter.dataset)
    assert "Ann minus Bob, 3 episodes" in words
    assert "x: bias +0.10 mm" in words
    assert "y: bias \N{MINUS SIGN}0.20 mm" in words
    assert "RMS 0.22 mm" in words


def test_agreement_and_log_are_shown(desk, qtbot):
    side = desk.page.side
    desk.do(KEY.Key_Return)
    side.choose(1)
    desk.workspace._search("")
    desk.settle()
    assert "No two people" in side.agreement.text()
    side.choose(2)
    side.needle.setText("accept")
    qtbot.waitUntil(lambda: side.log.count() == 1, timeout=60_000)
    assert "Ann: accept next" in side.log.item(0).text()


def test_the_model_scores_the_dataset_beside_the_labels(desk, qtbot):
    before = content(desk)
    desk.workspace.presenter.choose_queue("disagreement")
    desk.settle()
    assert "Ctrl+M" in desk.page.nothing.button.text()
    desk.press(KEY.Key_M, CTRL)
    wait(desk, qtbot, "were scored")
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
    desk.workspace.whole.merge()
    desk.page.words.setText(str(other))
    desk.press(KEY.Key_Return)
    wait(desk, qtbot, "1 in conflict")
    assert desk.book.head(other_uuid).person == "Bob"
    presenter.choose_queue("conflicts")
    desk.settle()
    assert desk.uuid == uuid
    desk.do(KEY.Key_C)
    assert desk.page.choice.isVisible()
    desk.do(KEY.Key_1)
    assert len(desk.book.conflicting(uuid)) == 1


def test_what_is_no_copy_is_refused(desk, qtbot, tmp_path):
    desk.workspace.whole.merge()
    desk.page.words.setText(str(tmp_path / "nowhere"))
    desk.press(KEY.Key_Return)
    wait(desk, qtbot, "nowhere")
