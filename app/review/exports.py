"""Export of pictures and episodes from review."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from PySide6.QtCore import QBuffer, QIODevice, QPoint, QProcess, QRect, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPaintDevice, QPainter, QPixmap
from PySide6.QtSvg import QSvgGenerator
from PySide6.QtWidgets import QAbstractButton, QComboBox, QWidget

from touchdown.app.review.timing import TrialTimeline
from touchdown.backend.core import write_atomically
from touchdown.backend.geometry import Outline
from touchdown.widgets.base import Theme, tr, ui_font

MARGIN_PX = 12


def export_picture(
    view: QWidget, theme: Theme, folder: Path, name: str, caption: str
) -> tuple[Path, Path]:
    """Write ``view`` under ``caption`` as PNG and SVG. Raises ``OSError``.

    Buttons are left out.
    """
    png, svg = folder / f"{name}.png", folder / f"{name}.svg"
    write_atomically(png, view_picture(view, theme, caption))
    size, content = _size(view, theme), QBuffer()
    generator = QSvgGenerator()
    generator.setOutputDevice(content)
    generator.setSize(size)
    generator.setViewBox(QRect(QPoint(0, 0), size))
    generator.setTitle(caption)
    _draw(generator, view, theme, caption)
    write_atomically(svg, bytes(content.data().data()))
    return png, svg


def view_picture(view: QWidget, theme: Theme, caption: str) -> bytes:
    """Return ``view`` under ``caption`` as the bytes of a PNG file."""
    ratio = view.devicePixelRatioF()
    picture = QPixmap(_size(view, theme) * ratio)
    picture.setDevicePixelRatio(ratio)
    _draw(picture, view, theme, caption)
    content = QBuffer()
    content.open(QIODevice.OpenModeFlag.WriteOnly)
    picture.save(content, "PNG")
    return bytes(content.data().data())


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
    """Hide the buttons for a while, without changing the layout."""
    found: list[QWidget] = [*view.findChildren(QAbstractButton), *view.findChildren(QComboBox)]
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


COLUMNS = (
    "trial", "seed", "probe", "decided_s", "x_mm", "y_mm", "verdict", "margin_mm", "action",
    "iou_percent", "accuracy_percent", "outcome", "episode",
)  # fmt: skip
VIEWER = "xdg-open"


def probe_table(trials: Iterable[tuple[TrialTimeline, Outline | None]]) -> str:
    """Return one CSV line per probe, with estimate and truth where it is known.

    Each trial is given with the face of its bottom.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for trial, bottom in trials:
        writer.writerows(_rows(trial, bottom))
    return text.getvalue()


def _rows(trial: TrialTimeline, bottom: Outline | None) -> Iterator[tuple[object, ...]]:
    whole = trial.story(float("inf"))
    outcome = "" if whole.finished is None else whole.finished.outcome.name.lower()
    episodes = {event.probe: event.episode.episode_id for event in trial.episodes()}
    for look in whole.probes:
        at_s = trial.decided_s(look.probe)
        score, s = trial.score(at_s, bottom), look.stability
        x, y = look.offset_mm or (None, None)
        yield (
            whole.trial, whole.seed, look.probe, f"{at_s:.3f}", _mm(x), _mm(y),
            "" if s is None else "stable" if s.stable else "unstable",
            "" if s is None else _mm(s.margin_mm),
            "" if look.action is None else look.action.kind,
            "" if score is None else f"{100 * score.iou:.2f}",
            "" if score is None else f"{100 * score.accuracy:.2f}",
            outcome, episodes.get(look.probe, ""),
        )  # fmt: skip


def write_export(text: str, folder: Path, name: str) -> Path:
    """Write a table or a page. Raises ``OSError``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    write_atomically(path, text.encode())
    return path


def open_in_viewer(path: Path) -> str:
    """Open ``path`` in the viewer of the desktop; return a message."""
    program = shutil.which(VIEWER)
    if program is None:
        return tr("This computer has no {}: the file is {}", VIEWER, path)
    if not QProcess.startDetached(program, [str(path)])[0]:
        return tr("{} did not start: the file is {}", VIEWER, path)
    return tr("Opened outside: {}", path)


def dated_file_name(name: str) -> str:
    """Return a file name that starts with the date and has no path separators."""
    safe = "".join(c if c.isalnum() or c in "-_" else "-" for c in name)
    return f"{datetime.now():%Y%m%d-%H%M%S}-{safe}"


def _mm(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
