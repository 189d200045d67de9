"""What a badge rests on, and that a deleted episode comes back as it was."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.app.label.conftest import KEY
from touchdown.app.label.evidence import evidence_badges, model_evidence_text, scene_evidence_text
from touchdown.app.shell.label_items import LabelDraft, ModelLabel, SceneObservation, scene_shots
from touchdown.backend.annotations.values import Label
from touchdown.backend.placement.estimator import OffsetFit
from touchdown.backend.sensing.scene_camera import Homography

BOARD = Homography(np.diag([4.0, 4.0, 1.0]), 0.2)
IMAGES = (np.zeros((48, 64, 3), np.uint8),) * 2


def edit(x_mm=1.0, sigma_mm=0.15):
    label = Label(round(1e3 * x_mm), 0, 0, round(1e3 * sigma_mm))
    head = SimpleNamespace(label=label, source="measured", rev_uuid="r1")
    return LabelDraft(head, label, "measured")


def item(seen=None, model=None, pictures=True, doubt=None):
    place = None if seen is None else OffsetFit(seen, 0.12)
    scene = SceneObservation(IMAGES, BOARD, place) if pictures else None
    felt = None if model is None else ModelLabel(OffsetFit(model, 0.5), 0.1, "ab" * 32)
    return SimpleNamespace(scene=scene, model=felt, doubt=doubt)


def replace_doubt(seen, doubt):
    return SimpleNamespace(scene=seen.scene, model=seen.model, doubt=doubt)


def replace_base(now, rev_uuid):
    return replace(now, base=SimpleNamespace(**{**vars(now.base), "rev_uuid": rev_uuid}))


class TestBadge:
    def test_a_slip_that_the_camera_saw_is_told_in_sigmas(self):
        sigma = np.hypot(0.15, 0.12)
        assert evidence_badges(edit(1.0), item((2.0, 0.0))) == (
            f"scene {1 / sigma:.1f} \u03c3 off",
        )
        assert evidence_badges(edit(1.0), item((1.3, 0.2))) == ()

    def test_where_the_camera_measured_the_model_is_not_asked(self):
        assert evidence_badges(edit(1.0), item((1.0, 0.0), model=(9.0, 0.0))) == ()

    @pytest.mark.parametrize("pictures", [True, False])
    def test_without_a_measured_face_the_model_speaks(self, pictures):
        (badge,) = evidence_badges(edit(1.0), item(None, model=(9.0, 0.0), pictures=pictures))
        assert badge.startswith("model 15")

    def test_the_other_episodes_are_asked_before_the_model(self):
        seen = item(None, model=(9.0, 0.0), pictures=False, doubt=("r1", 16.0))
        assert evidence_badges(edit(1.0), seen) == ("signals 4.0 \u03c3 off",)
        assert evidence_badges(edit(1.0), replace_doubt(seen, ("r1", 8.0))) == ()
        for judged in (edit(1.0).placed(2.0, 0.0), replace_base(edit(1.0), "r2")):
            assert evidence_badges(judged, seen)[0].startswith("model")  # another label was judged

    def test_a_label_without_displacement_has_none(self):
        blank = replace(edit(), label=Label())
        assert evidence_badges(blank, item((2.0, 0.0), model=(9.0, 0.0))) == ()


def test_the_words_say_what_was_seen_and_what_was_not():
    assert "x +2.00, y +0.00 mm \u00b1 0.12, 5.2 sigma off" in scene_evidence_text(
        edit(), item((2.0, 0.0)), hidden=False
    )
    assert "rim" in scene_evidence_text(edit(), item(), hidden=False)
    assert "No scene picture" in scene_evidence_text(edit(), item(pictures=False), hidden=False)
    assert not scene_evidence_text(edit(), item((2.0, 0.0)), hidden=True)
    assert "hidden" in model_evidence_text(edit(), item((2.0, 0.0)), hidden=True)


def test_outlines_stand_where_the_homography_puts_them_and_what_was_seen_can_be_hidden():
    square = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    scene = item((3.0, 0.0)).scene
    pressed, lifted = scene_shots(scene, edit(1.0), (square, 2 * square), hidden=False)
    kinds = {o.kind: o.points_px for o in pressed.outlines}
    assert kinds["bottom"][0].tolist() == [8.0, 8.0]
    assert kinds["label"][0].tolist() == [8.0, 4.0]
    assert kinds["scene"][0].tolist() == [16.0, 4.0]
    assert [o.kind for o in lifted.outlines] == ["bottom"]
    blind = scene_shots(scene, edit(1.0), (square, square), hidden=True)
    assert [o.kind for o in blind[0].outlines] == ["bottom", "label"]
    assert scene_shots(None, edit(), (square, square), hidden=False) == ()


@pytest.mark.promise("W13")
def test_a_deleted_episode_comes_back_with_the_same_bytes_under_the_same_id(desk):
    desk.open()
    desk.settle()
    uuid, dataset = desk.uuid, desk.workspace.presenter.dataset
    path = dataset.path(uuid)
    before = path.read_bytes()
    desk.press(KEY.Key_Delete)
    desk.type("torn")
    desk.press(KEY.Key_Return)
    desk.settle()
    assert dataset.entry(uuid).deleted
    desk.press(KEY.Key_U)
    desk.settle()
    assert not dataset.entry(uuid).deleted
    assert dataset.path(uuid) == path
    assert path.read_bytes() == before
