"""What the live views keep between two pictures never shows in the second one."""

import numpy as np
import pytest
from PySide6.QtCore import QLineF, QRectF
from PySide6.QtGui import QColor, QImage, QPainter, QPen

from touchdown.widgets.plots.axes import LineBuffer
from touchdown.widgets.views.tactile import DimmedPicture

SIZE = (64, 48)


@pytest.fixture
def canvas(qapp):
    """Return what a drawing leaves on a black ground, as (48, 64) grey levels."""

    def drawn(draw):
        image = QImage(*SIZE, QImage.Format.Format_RGB32)
        image.fill(0)
        painter = QPainter(image)
        painter.setPen(QPen(QColor("#FFFFFF"), 2))
        draw(painter)
        painter.end()
        return (
            np.frombuffer(image.constBits(), np.uint8).reshape(SIZE[1], SIZE[0], 4)[..., 0].copy()
        )

    return drawn


def test_strokes_are_those_that_qt_draws_from_its_own_lines(canvas):
    rng, strokes = np.random.default_rng(3), LineBuffer()
    for count in (5, 40, 3, 0):
        lines = rng.uniform(0, 48, (count, 4))
        strokes.take(lines)
        some = canvas(lambda p, n=count: strokes.draw(p, n // 3, n))
        own = [QLineF(*line) for line in lines[count // 3 :].tolist()]
        assert (some == canvas(lambda p, own=own: p.drawLines(own) if own else None)).all()
        assert some.any() == bool(count)


def test_a_dimmed_picture_shows_nothing_of_the_one_before(canvas):
    picture, whole = DimmedPicture(), QRectF(0, 0, *SIZE)
    for shape, level in (((24, 32, 3), 200), ((24, 32, 3), 40), ((96, 128, 3), 120)):
        image = np.full(shape, level, np.uint8)
        for target in (whole, QRectF(8, 6, 20, 15)):
            grey = canvas(lambda p, i=image, t=target: picture.draw(p, t, i, 1.0, 0.5))
            inside = np.zeros((SIZE[1], SIZE[0]), bool)
            x, y, width, height = target.toRect().getRect()
            inside[y : y + height, x : x + width] = True
            assert (grey[inside] == level // 2).all()
            assert not grey[~inside].any()
