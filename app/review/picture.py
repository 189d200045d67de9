"""The picture of what Review shows: its views under a line that says what they are."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PySide6.QtCore import QBuffer, QIODevice, QPoint, QRect, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPaintDevice, QPainter, QPixmap
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
    png.write_bytes(picture_of(view, theme, caption))
    size = _size(view, theme)
    generator = QSvgGenerator()
    generator.setFileName(str(svg))
    generator.setSize(size)
    generator.setViewBox(QRect(QPoint(0, 0), size))
    generator.setTitle(caption)
    _draw(generator, view, theme, caption)
    if not svg.is_file():
        raise OSError(None, "the picture cannot be written", str(svg))
    return png, svg


def picture_of(view: QWidget, theme: Theme, caption: str) -> bytes:
    """Return ``view`` as it is shown, under ``caption``, as the bytes of a PNG file."""
    ratio = view.devicePixelRatioF()
    picture = QPixmap(_size(view, theme) * ratio)
    picture.setDevicePixelRatio(ratio)
    _draw(picture, view, theme, caption)
    content = QBuffer()
    content.open(QIODevice.OpenModeFlag.WriteOnly)
    picture.save(content, "PNG")
    return bytes(content.data().data())


def trial_caption(run: str, trial: TimedTrial) -> str:
    """Say which trial of which run is shown."""
    whole = trial.story(float("inf"))
    pair = f"{trial.head.piece} on {trial.head.bottom}"
    return f"Run {run}: {pair}, trial {whole.trial}, seed {whole.seed}"


def episode_caption(whole: str, entry: EpisodeEntry) -> str:
    """Say which episode of ``whole`` (a series, or a run that collected) is shown."""
    return f"{whole}: {entry.piece} on {entry.bottom}, episode {entry.uuid}"


def _draw(device: QPaintDevice, view: QWidget, theme: Theme, caption: str) -> None:
    size, head_px = _size(view, theme), _head_px(theme)
    painter = QPainter(device)
    painter.fillRect(QRect(QPoint(0, 0), size), theme.tokens.colour("bg"))
    painter.setPen(theme.tokens.colour("text"))
    painter.setFont(ui_font(theme.scale))
    line = QRect(MARGIN_PX, 0, size.width() - 2 * MARGIN_PX, head_px)
    fitting = painter.fontMetrics().elidedText(caption, Qt.TextElideMode.ElideMiddle, line.width())
    painter.drawText(line, Qt.AlignmentFlag.AlignVCenter | Qt.AlignmentFlag.AlignLeft, fitting)
    with _without_buttons(view):
        view.render(painter, QPoint(0, head_px))
    painter.end()


def _size(view: QWidget, theme: Theme) -> QSize:
    return QSize(view.width(), view.height() + _head_px(theme))


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
