"""The style sheet of the application."""

from __future__ import annotations

from collections.abc import Mapping

_SHEET = """
* {{ outline: none; }}
QWidget#frame, QMainWindow {{ background: {bg}; }}
QDialog {{ background: {panel}; border: 1px solid {border}; }}
QToolTip {{ background: {raised}; color: {text}; border: 1px solid {border}; padding: 4px 6px; }}

QFrame[role="bar"] {{ background: {panel}; border: none; border-bottom: 1px solid {hairline}; }}
QFrame[role="foot"] {{ background: {panel}; border: none; border-top: 1px solid {hairline}; }}
QFrame[role="rail"] {{ background: {panel}; border: none; border-right: 1px solid {hairline}; }}
QFrame[role="card"] {{ background: {panel}; border: 1px solid {hairline}; border-radius: 6px; }}
QFrame[role="rule"] {{ background: {hairline}; border: none; max-height: 1px; min-height: 1px; }}
QFrame[role="chip"] {{ background: {raised}; border: 1px solid {hairline}; border-radius: 6px; }}
QFrame[role="fault"], QFrame[role="notice"], QFrame[role="question"] {{ background: {panel};
    border: 1px solid {border}; border-left: 6px solid {pill_red}; border-radius: 4px; }}
QFrame[role="notice"] {{ border-left-color: {pill_yellow}; }}
QFrame[role="question"] {{ border-left-color: {pill_blue}; }}

QLabel {{ background: transparent; color: {text}; }}
QLabel[role="title"] {{ font-weight: 600; }}
QLabel[role="muted"] {{ color: {muted}; }}
QLabel[role="small"] {{ color: {muted}; font-size: {small}pt; }}
QLabel[role="head"] {{ font-size: {head}pt; font-weight: 600; }}
QLabel[role="figure"] {{ font-size: {figure}pt; font-weight: 600; }}
QLabel[tone="good"] {{ color: {good}; }}
QLabel[tone="bad"] {{ color: {bad}; }}

QPushButton, QToolButton {{ background: {raised}; color: {text}; border: 1px solid {border};
    border-radius: 5px; padding: 5px 12px; min-height: 24px; font-weight: 500; }}
QPushButton:hover, QToolButton:hover {{ background: {hover}; }}
QPushButton:pressed, QToolButton:pressed {{ background: {panel}; }}
QPushButton:disabled, QToolButton:disabled {{ color: {disabled}; border-color: {hairline};
    background: {panel}; }}
QPushButton:focus, QToolButton:focus, QComboBox:focus, QAbstractSpinBox:focus, QLineEdit:focus {{
    border: 2px solid {focus}; }}
QPushButton[role="primary"] {{ background: {text}; color: {panel}; border-color: {text};
    font-weight: 600; min-height: 28px; }}
QPushButton[role="primary"]:hover {{ background: {muted}; }}
QPushButton[role="primary"]:focus {{ border: 2px solid {focus}; }}
QPushButton[role="primary"]:disabled {{ background: {panel}; color: {disabled};
    border-color: {hairline}; }}
QPushButton[role="reset"] {{ background: {reset}; color: {on_dark}; border: 1px solid {border};
    font-weight: 600; }}
QPushButton[role="reset"]:hover {{ background: {selection}; color: {selection_text}; }}
QPushButton[role="reset"]:focus {{ border: 2px solid {focus}; }}
QPushButton[role="stop"] {{ background: {stop}; color: {on_dark}; border: 2px solid {text};
    border-radius: 0; padding: 2px 14px; font-weight: 600; min-height: 32px; }}
QPushButton[role="stop"]:hover {{ background: {pill_red}; }}
QPushButton[role="stop"]:pressed {{ background: {on_light}; }}
QToolButton[role="rail"] {{ background: transparent; border: 2px solid transparent;
    border-left-width: 3px; border-radius: 6px; padding: 4px 0;
    color: {muted}; font-size: {small}pt; min-height: 24px; }}
QToolButton[role="rail"]:hover {{ background: {raised}; color: {text}; }}
QToolButton[role="rail"]:checked {{ background: {raised}; color: {text}; font-weight: 600;
    border-left-color: {focus}; border-radius: 3px; }}
QToolButton[role="rail"]:focus {{ border-color: {focus}; }}
QToolButton[role="field"] {{ padding: 3px 8px; }}
QToolButton[role="plain"] {{ background: transparent; border: 1px solid transparent;
    padding: 2px 6px; min-height: 20px; color: {muted}; }}
QToolButton[role="plain"]:hover {{ background: {raised}; color: {text}; }}
QToolButton[role="plain"]:focus {{ border: 1px solid {focus}; }}

QPushButton[role="hold"] {{ padding: 2px; font-weight: 600; min-height: 40px; }}
QPushButton[role="choice"] {{ padding: 2px 6px; min-height: 22px; }}
QPushButton[role="choice"]:checked, QPushButton:checked {{ background: {selection};
    color: {selection_text}; border-color: {selection}; }}
QFrame[role="card"][armed="yes"] {{ border: 3px solid {focus}; }}
QPushButton[role="hold"][chosen="yes"] {{ border: 3px solid {focus}; }}
QAbstractSpinBox[refused="yes"] {{ border: 2px solid {bad}; }}

QComboBox, QAbstractSpinBox, QLineEdit {{ background: {bg}; color: {text};
    placeholder-text-color: {muted};
    border: 1px solid {border}; border-radius: 5px; padding: 3px 8px; min-height: 24px;
    selection-background-color: {selection}; selection-color: {selection_text}; }}
QComboBox:disabled, QAbstractSpinBox:disabled, QLineEdit:disabled {{ color: {muted};
    border-color: {hairline}; background: {panel}; }}
QComboBox::drop-down {{ border: none; width: {drop}px; }}
QCheckBox::indicator {{ width: {tick}px; height: {tick}px; border: 1px solid {border};
    border-radius: 3px; background: {bg}; }}
QCheckBox::indicator:checked {{ image: url(icons:tick-{name}.svg); }}
QCheckBox::indicator:disabled {{ border-color: {hairline}; }}
QCheckBox::indicator:focus {{ border: 2px solid {focus}; }}
QComboBox::down-arrow {{ image: url(icons:down-{name}.svg); width: {arrow}px; height: {arrow}px; }}
QComboBox::down-arrow:disabled {{ image: none; }}
QComboBox QAbstractItemView {{ background: {raised}; color: {text}; border: 1px solid {border};
    selection-background-color: {selection}; selection-color: {selection_text}; }}
QAbstractSpinBox::up-button, QAbstractSpinBox::down-button {{ border: none; width: {step}px;
    background: transparent; }}
QAbstractSpinBox::up-arrow {{ image: url(icons:up-{name}.svg);
    width: {small_arrow}px; height: {small_arrow}px; }}
QAbstractSpinBox::down-arrow {{ image: url(icons:down-{name}.svg);
    width: {small_arrow}px; height: {small_arrow}px; }}
QAbstractSpinBox::up-arrow:off, QAbstractSpinBox::down-arrow:off {{ image: none; }}

QAbstractSpinBox QLineEdit {{ border: none; padding: 0; background: transparent;
    min-height: 0; }}
QComboBox[role="compact"] {{ padding: 0 6px; min-height: 18px; font-size: {small}pt; }}

QPushButton[role="compact"] {{ padding: 0 4px; min-height: 18px; font-size: {small}pt; }}
QPushButton[low="yes"] {{ padding: 0 10px; min-height: 22px; }}
QPushButton[role="header"] {{ padding: 1px 8px; min-height: 22px; }}
QPushButton[role="header"]:checked {{ background: {selection}; color: {selection_text};
    border-color: {selection}; }}

QSpinBox[role="compact"] {{ padding: 0 4px; min-height: 18px; font-size: {small}pt; }}
QSpinBox[role="compact"]::up-button, QSpinBox[role="compact"]::down-button {{ width: 0; }}
QSpinBox[role="compact"]::up-arrow, QSpinBox[role="compact"]::down-arrow {{ image: none; }}

QSlider::groove:horizontal {{ height: 4px; background: {hairline}; border-radius: 2px; }}
QSlider::sub-page:horizontal {{ background: {focus}; border-radius: 2px; }}
QSlider::handle:horizontal {{ width: 14px; margin: -6px 0; background: {raised};
    border: 2px solid {border}; border-radius: 4px; }}
QSlider::handle:horizontal:focus {{ border-color: {focus}; }}

QSplitter#columns::handle {{ background: transparent; }}
QSplitter#columns::handle:enabled {{ background: {hairline}; border-radius: 3px; }}
QSplitter#columns::handle:enabled:hover, QSplitter#columns::handle:enabled:focus {{
    background: {focus}; }}
QMenu::item:disabled {{ color: {disabled}; }}
QMenu::separator {{ height: 1px; background: {hairline}; margin: 4px 8px; }}
QMenu {{ background: {raised}; color: {text}; border: 1px solid {border}; padding: 4px; }}
QMenu::item {{ padding: 5px 24px 5px 12px; border-radius: 4px; }}
QMenu::item:selected {{ background: {selection}; color: {selection_text}; }}
QScrollArea, QScrollArea > QWidget > QWidget, QScrollArea::corner {{
    background: transparent; border: none; }}
QScrollBar:vertical {{ background: transparent; width: 10px; margin: 0; }}
QScrollBar:horizontal {{ background: transparent; height: 10px; margin: 0; }}
QScrollBar::handle {{ background: {border}; border-radius: 4px;
    min-height: 24px; min-width: 24px; }}
QScrollBar::add-line, QScrollBar::sub-line {{ width: 0; height: 0; }}
QScrollBar::add-page, QScrollBar::sub-page {{ background: transparent; }}
QListWidget, QPlainTextEdit, QTableWidget {{ background: {bg}; color: {text};
    placeholder-text-color: {muted};
    border: 1px solid {hairline}; border-radius: 5px; selection-background-color: {selection};
    selection-color: {selection_text}; }}
QHeaderView::section {{ background: {panel}; color: {muted}; border: none;
    border-bottom: 1px solid {hairline}; padding: 2px 6px; font-size: {small}pt; }}
QTableCornerButton::section {{ background: {panel}; border: none; }}
QTableWidget::item {{ padding: 0 6px; }}
QListWidget:focus, QPlainTextEdit:focus, QTableWidget:focus {{ border: 2px solid {focus}; }}
QListWidget::item {{ padding: 6px 8px; }}
"""

# The contrast theme is black and white: disabled widgets also get a dashed frame.
_CONTRAST = """
QPushButton:disabled, QToolButton:disabled, QPushButton[role="primary"]:disabled,
QComboBox:disabled, QAbstractSpinBox:disabled, QLineEdit:disabled {{ color: {disabled};
    border: 1px dashed {border}; font-weight: 400; }}
QAbstractSpinBox QLineEdit:disabled {{ border: none; }}
QToolButton[role="rail"]:disabled, QToolButton[role="plain"]:disabled {{ border: none; }}
QAbstractSpinBox::up-arrow:disabled, QAbstractSpinBox::down-arrow:disabled {{ image: none; }}
"""


# Size of marks in px per point of the text.
MARKS = {"arrow": 1.0, "small_arrow": 0.9, "tick": 1.3, "drop": 2.2, "step": 1.8}


def make_style_sheet(tokens: Mapping[str, str], points: float) -> str:
    """Return the style sheet for the tokens of a theme and the base font size in points."""
    sizes = {
        "small": f"{points * 0.9:.2f}",
        "head": f"{points * 1.15:.2f}",
        "figure": f"{points * 1.7:.2f}",
    }
    for mark, share in MARKS.items():
        sizes[mark] = f"{share * points:.0f}"
    sheet = _SHEET + _CONTRAST if tokens["name"] == "contrast" else _SHEET
    return sheet.format(**tokens, **sizes)
