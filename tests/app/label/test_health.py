"""What is out of order in the dataset becomes queues of its own."""

from datetime import datetime

from tests.app.label.conftest import CTRL, ITEMS, KEY
from touchdown.app.label.presenter import group_findings, health_text
from touchdown.backend.annotations.dataset import QualityReport
from touchdown.backend.episodes.quality import QualityIssue


def test_findings_are_grouped_by_kind_and_each_episode_keeps_its_words():
    kinds = group_findings([
        QualityIssue("jerk", ("a",), "It jumps by 1 N."),
        QualityIssue("twins", ("a", "b"), "Nearly the same."),
        QualityIssue("jerk", ("c",), "It jumps by 2 N."),
    ])  # fmt: skip
    assert [kind.title for kind in kinds] == ["Jerk: 2 episodes", "Twins: 2 episodes"]
    assert kinds[0].said == {"a": "It jumps by 1 N.", "c": "It jumps by 2 N."}
    assert kinds[0].first == "It jumps by 1 N."
    at = datetime(2026, 1, 1, 9, 5)
    assert health_text(QualityReport((), 1200, 1200), 0, at) == (
        "1,200 episodes were checked at 09:05: no problems were found."
    )
    assert health_text(QualityReport((), 7, 9), 2, at).startswith("7 of 9 episodes")


def test_a_finding_opens_its_episodes_as_a_queue(desk, qtbot):
    desk.press(KEY.Key_F)
    assert "Ctrl+H" in desk.page.message.text()
    standing = desk.page.queue.currentText()
    desk.press(KEY.Key_H, CTRL)
    qtbot.waitUntil(lambda: desk.page.health.list.count() > 0, timeout=60_000)
    assert desk.page.health.isVisible()
    assert f"{ITEMS} episodes were checked" in desk.page.health.said.text()
    kinds = desk.workspace.health.kinds
    at = next(k for k, kind in enumerate(kinds) if kind.name == "Jerk")
    desk.press(KEY.Key_F)
    desk.press(KEY.Key_1 + at)
    desk.settle()
    assert desk.workspace.presenter.walk.order == list(kinds[at].said)
    assert desk.page.queue.currentText() == kinds[at].title
    assert desk.page.message.text() == kinds[at].said[desk.uuid]
    first = desk.uuid
    desk.do(KEY.Key_Return)
    assert desk.book.head(first).state == "submitted"
    assert desk.page.message.text() == kinds[at].said[desk.uuid]
    assert desk.workspace.memory()["queue"] == "unlabelled"  # a finding does not outlive the window
    desk.workspace._choose_queue("unlabelled")
    desk.workspace.recall(desk.workspace.memory())
    desk.settle()
    assert desk.page.queue.currentText() == standing
