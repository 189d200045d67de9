"""Sheet that adds a piece from a CAD file, by choosing or dropping the file."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import isnan
from pathlib import Path
from typing import get_args

from PySide6.QtCore import QRectF, Qt, QTimer
from PySide6.QtGui import QPainter
from PySide6.QtSvg import QSvgRenderer
from PySide6.QtWidgets import QComboBox, QLineEdit, QWidget

from touchdown.app.shell import BenchSheet, FileDrop, SaveWorker, ask_path
from touchdown.backend import geometry
from touchdown.backend.core import InputError
from touchdown.widgets.base import Theme, hbox, label, push_button, set_property, tr
from touchdown.widgets.forms import FormFields, decimal_box, set_entries
from touchdown.widgets.plots import PictureView

MEASURE_AFTER_MS = 300  # pause after an edit before the file is measured again
ROLES = (("top", "is grasped"), ("bottom", "is stacked upon"), ("both", "both"))
COMS = (("", "automatic"), ("uniform", "uniform density"), ("unknown", "unknown, weighed"))
UNITS = (("", "as in the file, or mm"), *((unit, unit) for unit in geometry.UNITS_MM))
DRAWN = "drawing"  # face of a file that holds only an outline
FACES = (*((end, end) for end in get_args(geometry.PieceEnd)), (DRAWN, "drawn outline"))
NO_FILE = "Choose a mesh (STL, OBJ, PLY, OFF) or an outline (SVG, DXF), or drop one here."


class PiecePicture(PictureView):
    """Picture of a measured piece, in the colours of the theme."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Picture of the piece", (220, 220), (300, 300))
        self._piece: geometry.MeasuredPiece | None = None

    def show_piece(self, piece: geometry.MeasuredPiece | None) -> None:
        """Show a piece, or nothing."""
        self._piece = piece
        self.update()

    def paint(self, painter: QPainter) -> None:
        """Draw the picture, as large as fits."""
        painter.fillRect(self.rect().adjusted(0, 0, 1, 1), self._theme.tokens.colour("bg"))
        if self._piece is None:
            return
        tokens = self._theme.tokens
        letter_px = 0.7 * self.fontMetrics().height() * geometry.PICTURE_PX / max(self.width(), 1)
        text = geometry.piece_svg(self._piece, "", tokens.text, tokens.bg, letter_px)
        svg = QSvgRenderer(text.encode())
        size = svg.viewBoxF().size()
        share = min(self.width() / size.width(), self.height() / size.height())
        wide, high = share * size.width(), share * size.height()
        x, y = (self.width() - wide) / 2, (self.height() - high) / 2
        svg.render(painter, QRectF(x, y, wide, high))


class PieceSheet(BenchSheet):
    """Sheet with file, numbers and picture of a new piece; ``added`` gets its name.

    The file is measured on a thread of its own.
    """

    def __init__(self, parent: QWidget, theme: Theme, added: Callable[[str], None]) -> None:
        super().__init__(parent, "Add a piece")
        self._added = added
        self._path: Path | None = None
        self._measured: geometry.MeasuredPiece | None = None
        self._worker = SaveWorker(self, "piece-import")
        self._asked = 0  # number of the newest measurement
        self._delay = QTimer(self, interval=MEASURE_AFTER_MS, singleShot=True)
        self._delay.timeout.connect(self.measure)
        self.choose = push_button("Choose a file\N{HORIZONTAL ELLIPSIS}")
        self.add = push_button("Add piece", role="primary")
        self.file, self.said = label(NO_FILE, wrap=True), label("", "small", wrap=True)
        self.picture = PiecePicture(theme)
        self.name, self.face, self.role, self.units, self.com = (
            QLineEdit(), QComboBox(), QComboBox(), QComboBox(), QComboBox()
        )  # fmt: skip
        self.density, self.mass_g = decimal_box(0.0, 25.0), decimal_box(0.0, 10_000.0)
        self.height_mm, self.grip_mm = decimal_box(0.0, 300.0), decimal_box(0.0, 300.0)
        for combo, entries in ((self.face, FACES), (self.role, ROLES), (self.units, UNITS),
                               (self.com, COMS)):  # fmt: skip
            set_entries(combo, entries)
            combo.currentIndexChanged.connect(self._delay.start)
        for box, auto in ((self.mass_g, "by density"), (self.height_mm, "measured"),
                          (self.grip_mm, "0.7 of the height")):  # fmt: skip
            box.setSpecialValueText(tr(auto))
        self.density.setValue(1.24)
        for box in (self.density, self.mass_g, self.height_mm, self.grip_mm):
            box.valueChanged.connect(self._delay.start)
        self.choose.clicked.connect(self._ask_file)
        self.add.clicked.connect(self._save)
        FileDrop(self, geometry.PIECE_SOURCES, self.take)
        self._arrange()
        self._show(None, "")

    def take(self, path: Path) -> None:
        """Measure a file with the present numbers."""
        self._path = path
        self.file.setText(path.name)
        self.file.setToolTip(str(path))
        self.name.setText(geometry.piece_name(path))
        drawn = path.suffix.lower() in (".svg", ".dxf")
        if drawn is not (self.face.currentData() == DRAWN):
            self.face.setCurrentIndex(self.face.findData(DRAWN if drawn else "bottom"))
        self.present()
        self.measure()

    def measure(self) -> None:
        """Measure the file on the thread; a newer measurement replaces an older one."""
        self._delay.stop()
        if self._path is None:
            return
        self._asked += 1
        self._show(None, "Measuring\N{HORIZONTAL ELLIPSIS}")
        work = partial(geometry.measure_piece, self._path, self._wanted())
        self._submit(work, partial(self._measurement, self._asked))

    def close_worker(self) -> None:
        """End the thread."""
        self._worker.close()

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self) -> None:
        fields = FormFields(
            12, 6, face=self.face, role=self.role, units=self.units, density=self.density,
            mass=self.mass_g, com=self.com, height=self.height_mm, grip=self.grip_mm,
        )  # fmt: skip
        fields.add_wide(
            0,
            ("Name", self.name, "Small letters, digits, '-' and '_'"),
            ("Face", self.face, "Side of the mesh that is the contact face"),
            ("Role", self.role, "The piece is grasped and placed, or stacked upon"),
            ("Unit", self.units, "Length unit of the file"),
            ("Density, g/cm³", self.density, "Uniform density, such as 1.24 of PLA"),
            ("Mass, g", self.mass_g, "Mass of a weighed piece, instead of the density"),
            ("Centre of mass", self.com, "Of a uniform density, or measured by each run"),
            ("Height, mm", self.height_mm, "Height over a drawn outline"),
            ("Grip, mm", self.grip_mm, "Height of the grip above the face"),
        )
        fields.setContentsMargins(0, 0, 0, 0)
        left = QWidget()
        left.setLayout(fields)
        self.arrange(
            hbox(self.choose, (self.file, 1)), hbox((left, 1), (self.picture, 1), spacing=14),
            self.said, foot=(self.add,), spacing=10,
        )  # fmt: skip
        # Room for two lines, so that a longer answer does not squeeze the fields.
        self.said.setMinimumHeight(2 * self.said.fontMetrics().lineSpacing())
        self.said.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.resize_to_em(46, 36)

    def _wanted(self) -> geometry.PieceImport:
        drawn, mass = self.face.currentData() == DRAWN, self.mass_g.value() or None
        role = self.role.currentData()
        return geometry.PieceImport(
            end=None if drawn else self.face.currentData(),
            role=role,
            unit=self.units.currentData() or None,
            density_g_cm3=None if mass else self.density.value(),
            mass_g=mass,
            height_mm=self.height_mm.value() or None,
            grip_mm=None if role == "bottom" else self.grip_mm.value() or None,
            com=self.com.currentData() or None,
        )

    def _ask_file(self) -> None:
        kinds = " ".join(f"*{kind}" for kind in geometry.PIECE_SOURCES)
        start = None if self._path is None else self._path.parent
        names = f"{tr('CAD files')} ({kinds})"
        ask_path(self, "CAD file of the piece", self.take, start=start, names=names)

    def _submit(self, work: Callable[[], object], done: Callable[[object], None]) -> None:
        self._worker.submit(work, done, partial(self._failed, self._asked))

    def _measurement(self, number: int, measured: object) -> None:
        if number == self._asked and isinstance(measured, geometry.MeasuredPiece):
            x, y, z = measured.com_mm
            found = "Face {:.1f} mm², height {:.2f} mm, volume {:.2f} cm³, mass {:.1f} g."
            sizes = measured.face.area, measured.height_mm, 1e-3 * measured.volume_mm3
            words = [tr(found, *sizes, measured.mass_g)]
            if not isnan(x):
                words.append(tr("Centre of mass {:.2f}, {:.2f}, {:.2f} mm.", x, y, z))
            notes = " ".join((*words, *measured.notes))
            self._show(measured, notes.replace("--weigh", tr("Weigh first")))

    def _failed(self, number: int, error: Exception) -> None:
        if number == self._asked:
            words = f"{error.what} {error.fix}" if isinstance(error, InputError) else str(error)
            # Options of the command line are fields of this sheet.
            words = words.replace("--units", "the unit").replace("--", "")
            self._show(None, words, bad=True)

    def _show(
        self, measured: geometry.MeasuredPiece | None, words: str, *, bad: bool = False
    ) -> None:
        self._measured = measured
        self.add.setEnabled(measured is not None)
        self.picture.show_piece(measured)
        self.said.setText(tr(words))
        set_property(self.said, "tone", "bad" if bad else "")

    def _save(self) -> None:
        name = self.name.text().strip()
        if self._measured is not None:
            work = partial(geometry.save_piece, self._measured, name)
            self._submit(work, lambda _: self._saved(name))

    def _saved(self, name: str) -> None:
        self._show(None, tr("'{}' is added.", name))
        self._added(name)
        self.close()
