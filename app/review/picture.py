"""The picture of what Review shows: its views under a line that says what they are."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PySide6.QtCore import QPoint, QRect, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPainter, QPixmap
from PySide6.QtSvg import QSvgGenerator
from PySide6.QtWidgets import QAbstractButton, QComboBox, QWidget

from app.review.timed import TimedTrial
from backend.catalogue.values import EpisodeEntry
from widgets.theme import Theme, ui_font

MARGIN_PX = 12


def export_picture(
    view: QWidget, theme: Theme, folder: Path, name: str, caption: str
) -> tuple[Path, Path]:
    """Write ``view`` as it is shown, under ``caption``, as PNG and as SVG; raises ``OSError``.

    Buttons are left out: nobody can press them there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    png, svg = folder / f"{name}.png", folder / f"{name}.svg"
    size = QSize(view.width(), view.height() + _head_px(theme))
    ratio = view.devicePixelRatioF()
    picture = QPixmap(size * ratio)
    picture.setDevicePixelRatio(ratio)
    generator = QSvgGenerator()
    generator.setFileName(str(svg))
    generator.setSize(size)
    generator.setViewBox(QRect(QPoint(0, 0), size))
    generator.setTitle(caption)
    with _without_buttons(view):
        for device in (picture, generator):
            painter = QPainter(device)
            _draw(painter, view, theme, size, caption)
            painter.end()
    if not picture.save(str(png)) or not svg.is_file():
        raise OSError(None, "the picture cannot be written", str(png))
    return png, svg


def trial_caption(run: str, trial: TimedTrial) -> str:
    """Say which trial of which run is shown."""
    whole = trial.story(float("inf"))
    pair = f"{trial.head.piece} on {trial.head.bottom}"
    return f"Run {run}: {pair}, trial {whole.trial}, seed {whole.seed}"


def episode_caption(whole: str, entry: EpisodeEntry) -> str:
    """Say which episode of ``whole`` (a series, or a run that collected) is shown."""
    return f"{whole}: {entry.piece} on {entry.bottom}, episode {entry.uuid}"


def _draw(painter: QPainter, view: QWidget, theme: Theme, size: QSize, caption: str) -> None:
    head_px = _head_px(theme)
    painter.fillRect(QRect(QPoint(0, 0), size), theme.tokens.colour("bg"))
    painter.setPen(theme.tokens.colour("text"))
    painter.setFont(ui_font(theme.scale))
    line = QRect(MARGIN_PX, 0, size.width() - 2 * MARGIN_PX, head_px)
    fitting = painter.fontMetrics().elidedText(caption, Qt.TextElideMode.ElideMiddle, line.width())
    painter.drawText(line, Qt.AlignmentFlag.AlignVCenter | Qt.AlignmentFlag.AlignLeft, fitting)
    view.render(painter, QPoint(0, head_px))


def _head_px(theme: Theme) -> int:
    return QFontMetrics(ui_font(theme.scale)).height() + MARGIN_PX


@contextmanager
def _without_buttons(view: QWidget) -> Iterator[None]:
    """Hide the buttons meanwhile; what is beside them stays where it is."""
    found: list[QWidget] = [
        *view.findChildren(QAbstractButton),
        *view.findChildren(QComboBox),
    ]
    hidden = [one for one in found if one.isVisible()]
    before = [one.sizePolicy() for one in hidden]
    for one in hidden:
        policy = one.sizePolicy()
        policy.setRetainSizeWhenHidden(True)
        one.setSizePolicy(policy)
        one.hide()
    try:
        yield
    finally:
        for one, policy in zip(hidden, before, strict=True):
            one.show()
            one.setSizePolicy(policy)
