"""The sheet that adds a piece, driven as by its user."""

import pytest
import trimesh

from tests.app.conftest import drop
from touchdown.backend.geometry import load_pieces


@pytest.fixture
def block(tmp_path):
    path = tmp_path / "My block.stl"
    trimesh.creation.box((20.0, 24.0, 40.0)).export(path)
    return path


@pytest.fixture
def stack(live):
    return live.workspaces["stack"]


def test_a_dropped_mesh_becomes_a_piece_that_can_be_chosen(stack, block, qtbot):
    assert drop(stack.page, block)
    sheet = stack.pieces
    qtbot.waitUntil(sheet.add.isEnabled, timeout=10_000)
    assert sheet.isVisible()
    assert sheet.name.text() == "my-block"
    assert "mass 23.8 g" in sheet.said.text()
    sheet.add.click()
    qtbot.waitUntil(lambda: not sheet.isVisible(), timeout=10_000)
    assert load_pieces().top("my-block").mass_g == pytest.approx(23.808)
    combo = stack.page.run._piece
    assert combo.findData("my-block") >= 0
    # The same name again is refused in the sheet, which stays open.
    assert drop(stack.page, block)
    qtbot.waitUntil(sheet.add.isEnabled, timeout=10_000)
    sheet.add.click()
    qtbot.waitUntil(lambda: "already a piece 'my-block'" in sheet.said.text(), timeout=10_000)
    assert sheet.isVisible()


def test_a_mesh_that_cannot_be_used_says_why_until_the_numbers_fit(stack, block, qtbot):
    mesh = trimesh.load_mesh(block)
    mesh.apply_scale(1e-3)
    mesh.export(block)
    assert drop(stack.page, block)
    sheet = stack.pieces
    qtbot.waitUntil(
        lambda: "Give the unit m (20 x 24 x 40 mm)" in sheet.said.text(), timeout=10_000
    )
    assert not sheet.add.isEnabled()
    sheet.units.setCurrentIndex(sheet.units.findData("m"))
    sheet.measure()
    qtbot.waitUntil(sheet.add.isEnabled, timeout=10_000)


def test_the_centre_of_mass_can_be_left_to_a_weighing(stack, block, qtbot):
    assert drop(stack.page, block)
    sheet = stack.pieces
    sheet.mass_g.setValue(180.0)
    sheet.com.setCurrentIndex(sheet.com.findData("unknown"))
    sheet.measure()
    qtbot.waitUntil(lambda: "first (Weigh first)" in sheet.said.text(), timeout=10_000)
    # Two lines of text leave every field its whole height.
    assert all(
        box.height() >= box.minimumSizeHint().height() for box in (sheet.name, sheet.grip_mm)
    )
    assert sheet.grip_mm.mapTo(sheet, sheet.grip_mm.rect().bottomLeft()).y() < sheet.said.y()
    sheet.add.click()
    qtbot.waitUntil(lambda: not sheet.isVisible(), timeout=10_000)
    assert not load_pieces().top("my-block").com_known


def test_other_files_are_not_accepted(stack, block, tmp_path):
    assert not drop(stack.page, tmp_path / "notes.txt")
    assert not drop(stack.page, block, block)
    assert stack.pieces is None
