"""Views whose picture can be zoomed, moved, enlarged to the page, copied and saved."""

from __future__ import annotations

from dataclasses import dataclass

from PySide6.QtCore import QEvent, QObject, QPointF, QRectF, QSize, Qt
from PySide6.QtGui import (
    QColor,
    QGuiApplication,
    QKeyEvent,
    QKeySequence,
    QMouseEvent,
    QPainter,
    QPaintEvent,
    QPen,
    QPixmap,
    QWheelEvent,
)
from PySide6.QtWidgets import QFileDialog, QMessageBox, QSizePolicy, QStackedWidget, QWidget

from touchdown.widgets.base import Theme, signed, tr, ui_font
from touchdown.widgets.plots.axes import PlotArea

WHEEL_STEP, MENU_STEP, MOVE_SHARE, LEAST_SHARE = 1.25, 1.6, 0.1, 0.02
UNLIMITED_PX = 16_777_215  # largest size of a widget in Qt
Span = tuple[float, float]  # start and length in shares of the whole


@dataclass(frozen=True, slots=True)
class Zoom:
    """Visible part of an area along x and along y."""

    x: Span = (0.0, 1.0)
    y: Span = (0.0, 1.0)

    def of(self, area: PlotArea) -> PlotArea:
        """Return the visible part of ``area`` on the same pixels."""
        across, up = area.x1 - area.x0, area.y1 - area.y0
        x0, y0 = area.x0 + self.x[0] * across, area.y0 + self.y[0] * up
        return PlotArea(area.rect, x0, x0 + self.x[1] * across, y0, y0 + self.y[1] * up)


WHOLE = Zoom()


def _closer(span: Span, at: float, factor: float) -> Span:
    """Shorten a span by a factor about a place in shares of it."""
    length = min(max(span[1] / factor, LEAST_SHARE), max(span[1], 1.0))
    return _within(span[0] + min(max(at, 0.0), 1.0) * (span[1] - length), length)


def _within(start: float, length: float) -> Span:
    """Keep a span inside the whole; centre a longer one."""
    return min(max(start, 0.0), 1.0 - length) if length <= 1.0 else (1.0 - length) / 2, length


class PictureView(QWidget):
    """View that paints itself, with zoom, a crosshair with values, and a menu of picture commands.

    It grows with its page; ``usual_px`` is the size hint; an ``opaque`` view paints every pixel.
    Subclasses draw in ``paint`` and apply ``zoom`` in ``area``. The wheel zooms about the pointer,
    along time alone in a plot, with Shift along its values. The left button moves a zoomed picture;
    in ``editable`` views, where it has another meaning, the middle button or Shift with the left.
    ``unit``: that of both axes, "" for a plot of two quantities.
    """

    unit = "mm"
    editable = False
    enlarged: QWidget | None = None  # keeps the place of the view while it is enlarged
    paints = 0
    _plain = False  # without crosshair, frame and hint

    def __init__(
        self,
        theme: Theme,
        name: str,
        least_px: tuple[int, int],
        usual_px: tuple[int, int] = (-1, -1),
        *,
        opaque: bool = True,
    ) -> None:
        super().__init__()
        self._theme, self._usual_px, self.zoom = theme, QSize(*usual_px), WHOLE
        self._pointer: QPointF | None = None
        self._grip: QPointF | None = None
        self.setAccessibleName(tr(name))
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(*least_px)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent, opaque)
        self.setMouseTracking(True)
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.setContextMenuPolicy(Qt.ContextMenuPolicy.ActionsContextMenu)
        for text, key, act in (
            ("Zoom &in", "", lambda: self.zoom_by(MENU_STEP)),
            ("Zoom &out", "", lambda: self.zoom_by(1 / MENU_STEP)),
            ("&Fit", "", lambda: self.show_zoom()),
            ("&1:1, pixel on pixel or mm on mm", "", self.show_actual_size),
            ("Move &left", "Ctrl+Left", lambda: self.move_by(-MOVE_SHARE, 0.0)),
            ("Move &right", "Ctrl+Right", lambda: self.move_by(MOVE_SHARE, 0.0)),
            ("Move &up", "Ctrl+Up", lambda: self.move_by(0.0, MOVE_SHARE)),
            ("Move &down", "Ctrl+Down", lambda: self.move_by(0.0, -MOVE_SHARE)),
            ("&Enlarge to the page, or put back", "", self.enlarge),
            ("&Copy picture", "", self.copy),
            ("&Save picture\N{HORIZONTAL ELLIPSIS}", "", self.save),
        ):
            action = self.addAction(tr(text), QKeySequence(key), act)
            action.setShortcutContext(Qt.ShortcutContext.WidgetShortcut)

    def sizeHint(self) -> QSize:
        """Return the usual size."""
        return self._usual_px

    def paint(self, painter: QPainter) -> None:
        """Draw the view."""
        raise NotImplementedError

    def area(self) -> PlotArea | None:
        """Return the visible area; None for a view without zoom."""
        return None

    def reading(self, x: float, y: float) -> str:
        """Return the values at a place of the area."""
        if self.unit == "px":
            return f"x {x:.0f}, y {y:.0f} px"
        decimals = 1 if self.unit else 3
        return f"x {signed(x, decimals)}, y {signed(y, decimals)} {self.unit}"

    def show_zoom(self, x: Span = WHOLE.x, y: Span = WHOLE.y) -> None:
        """Show a part of the picture, by default all of it."""
        self.zoom = Zoom(x, y)
        self.update()

    def zoom_by(self, across: float, up: float | None = None, at: QPointF | None = None) -> None:
        """Enlarge about a place of the view, by default the centre, along both axes alike."""
        area = self.area()
        if area is not None:
            off = (area.rect.center() if at is None else at) - area.rect.bottomLeft()
            x = _closer(self.zoom.x, off.x() / area.rect.width(), across)
            y = _closer(self.zoom.y, -off.y() / area.rect.height(), up or across)
            self.show_zoom(x, y)

    def move_by(self, across: float, up: float) -> None:
        """Move the visible part by shares of itself."""
        (x, width), (y, height) = self.zoom.x, self.zoom.y
        self.show_zoom(_within(x + across * width, width), _within(y + up * height, height))

    def show_actual_size(self) -> None:
        """Show one pixel of an image on one of the screen, or one mm as one mm."""
        area = self.area()
        if area is not None and self.unit:
            dots = self.screen().physicalDotsPerInch() / 25.4
            wanted = 1.0 / self.devicePixelRatioF() if self.unit == "px" else dots
            factor = wanted * abs(area.x1 - area.x0) / area.rect.width()
            parts = (
                (start + size / 2, size / factor) for start, size in (self.zoom.x, self.zoom.y)
            )
            self.show_zoom(*(_within(middle - size / 2, size) for middle, size in parts))

    def enlarge(self) -> None:
        """Show the view over its whole page; put it back if it is there."""
        gap, page = self.enlarged or QWidget(), self.parentWidget() or self
        out, into = (self, gap) if self.enlarged is None else (gap, self)
        layout = (out.parentWidget() or out).layout()
        if layout is not None:
            layout.replaceWidget(out, into)
        into.setMinimumSize(out.minimumSize())
        into.setMaximumSize(out.maximumSize())
        if into is gap:
            self.enlarged = gap
            gap.setSizePolicy(self.sizePolicy())
            while not page.isWindow() and not isinstance(page.parentWidget(), QStackedWidget):
                page = page.parentWidget() or page
            self.setMaximumSize(UNLIMITED_PX, UNLIMITED_PX)
            self.setAutoFillBackground(True)
            self.setParent(page)
            page.installEventFilter(self)
            self.setGeometry(page.rect())
            self.raise_()
        else:
            self.enlarged = None
            page.removeEventFilter(self)
            gap.deleteLater()
        self.show()
        self.setFocus()

    def copy(self) -> None:
        """Put the picture on the clipboard."""
        QGuiApplication.clipboard().setPixmap(self._grab())

    def save(self) -> None:
        """Save the picture as a file."""
        picture = self._grab()
        path, _ = QFileDialog.getSaveFileName(
            self, "Save picture", f"{self.accessibleName()}.png", "Pictures (*.png *.jpg)",
            options=QFileDialog.Option.DontUseNativeDialog,
        )  # fmt: skip
        if path and not picture.save(path):
            QMessageBox.warning(
                self, tr("Save picture"), tr("{} cannot be written. Choose another.", path)
            )

    def _grab(self) -> QPixmap:
        self._plain = True
        picture = self.grab()
        self._plain = False
        return picture

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Keep the size of the page while enlarged."""
        if event.type() is QEvent.Type.Resize and isinstance(watched, QWidget) and self.enlarged:
            self.setGeometry(watched.rect())
        return super().eventFilter(watched, event)

    def event(self, event: QEvent) -> bool:
        """Put an enlarged view back with Esc, before the shortcuts of the page."""
        if isinstance(event, QKeyEvent) and event.key() == Qt.Key.Key_Escape and self.enlarged:
            if event.type() is QEvent.Type.KeyPress:
                self.enlarge()
            event.accept()
            return True
        if event.type() is QEvent.Type.Leave:
            self._pointer = None
            self.update()
        return super().event(event)

    def wheelEvent(self, event: QWheelEvent) -> None:
        """Zoom about the pointer; leave the wheel to the page where that changes nothing."""
        before, factor = self.zoom, WHEEL_STEP ** (event.angleDelta().y() / 120)
        shift = bool(event.modifiers() & Qt.KeyboardModifier.ShiftModifier)
        across, up = (
            factor if self.unit or shift == vertical else 1.0 for vertical in (False, True)
        )
        self.zoom_by(across, up, event.position())
        event.setAccepted(self.zoom != before)

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Start to move a zoomed picture."""
        shift = event.modifiers() & Qt.KeyboardModifier.ShiftModifier
        left = event.button() is Qt.MouseButton.LeftButton and (shift or not self.editable)
        if self.zoom != WHOLE and (left or event.button() is Qt.MouseButton.MiddleButton):
            self._grip = event.position()

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """Move the picture or the crosshair."""
        area, at = self.area(), event.position()
        if area is None:
            return
        if self._grip is not None:
            by, self._grip = self._grip - at, at
            self.move_by(by.x() / area.rect.width(), -by.y() / area.rect.height())
        self._pointer = None if event.buttons() else at
        self.update()

    def mouseReleaseEvent(self, _event: QMouseEvent) -> None:
        """End the move."""
        self._grip = None

    def mouseDoubleClickEvent(self, event: QMouseEvent) -> None:
        """Enlarge the view, or put it back."""
        if self.editable:
            self.mousePressEvent(event)
        elif event.button() is Qt.MouseButton.LeftButton:
            self._grip = None
            self.enlarge()

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the view, the frame of the focus and the crosshair."""
        self.paints += 1
        at, area = self._pointer, self.area()
        with QPainter(self) as painter:
            painter.save()
            self.paint(painter)
            painter.restore()
            if self._plain:
                return
            if self.hasFocus():
                painter.setPen(QPen(self._theme.tokens.colour("focus"), 2))
                painter.drawRect(self.rect().adjusted(1, 1, -1, -1))
            if self.enlarged is not None:
                box, right = self.rect().adjusted(0, 4, -8, 0), Qt.AlignmentFlag.AlignRight
                painter.setPen(self._theme.tokens.colour("muted"))
                painter.drawText(box, int(right), tr("Esc: back"))
            if at is not None and area is not None and area.rect.contains(at):
                self._draw_crosshair(painter, area, at)

    def _draw_crosshair(self, painter: QPainter, area: PlotArea, at: QPointF) -> None:
        t, rect = self._theme.tokens, area.rect
        for colour, width in ((QColor(0, 0, 0, 130), 3), (QColor("#FFFFFF"), 1)):
            painter.setPen(QPen(colour, width))
            painter.drawLine(QPointF(rect.left(), at.y()), QPointF(rect.right(), at.y()))
            painter.drawLine(QPointF(at.x(), rect.top()), QPointF(at.x(), rect.bottom()))
        painter.setFont(ui_font(self._theme.scale, 0.85))
        text, metrics = self.reading(*area.at(at)), painter.fontMetrics()
        width, height = metrics.horizontalAdvance(text) + 12, metrics.height() + 6
        x = at.x() + 8 if at.x() + 8 + width <= self.width() else max(at.x() - 8 - width, 0.0)
        y = at.y() + 8 if at.y() + 8 + height <= self.height() else at.y() - 8 - height
        box = QRectF(x, y, width, height)
        painter.fillRect(box, t.colour("raised"))
        painter.setPen(t.colour("text"))
        painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), text)
