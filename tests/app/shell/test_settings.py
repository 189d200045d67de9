"""The frame: keys, names, sizes, settings that cannot break the start, errors that are shown."""

import errno
import json
import subprocess
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PySide6.QtCore import QRect, qWarning
from PySide6.QtGui import QAction, QImage
from PySide6.QtWidgets import QComboBox, QLabel, QPushButton

from tests.app.conftest import opened, settle
from tests.app.stand_in import StandInBench
from touchdown.app import __main__ as command_line
from touchdown.app.__main__ import incompatibility
from touchdown.app.shell.actions import EVERYWHERE_CONTEXT, STOP_BINDINGS, portable_key
from touchdown.app.shell.errors import ErrorBox, install_error_hooks, log, log_to
from touchdown.app.shell.settings import WindowSettings, load_settings, restore_form, save_settings
from touchdown.app.splash import Splash
from touchdown.backend.cli import main as touchdown_command
from touchdown.widgets.base.theme import THEMES
from touchdown.widgets.forms import PoseReadout, RunForm


@pytest.mark.promise("W11")
def test_no_two_commands_share_a_key_in_one_context(main):
    rows = main.actions.rows
    names = [row.id for row in rows if row.command is not None]
    assert len(names) == len(set(names))
    assert {row.context for row in rows} == {EVERYWHERE_CONTEXT, *main.workspaces}
    for context in main.workspaces:
        keys = [
            portable_key(r.key)
            for r in rows
            if r.context in (EVERYWHERE_CONTEXT, context) and r.key
        ]
        assert all(keys)
        assert sorted(set(keys)) == sorted(keys)


def test_no_action_or_shortcut_takes_a_stop_key(live):
    keys = {a.shortcut().toString() for a in live.window.findChildren(QAction)}
    assert not {key for key, _ in STOP_BINDINGS} & keys
    assert {"F12", "Space"} <= {row.key for row in live.actions.rows}


def test_only_the_keys_of_the_workspace_in_front_act(live):
    live.go("review")
    assert not live.actions.action("stack.start").isEnabled()
    assert live.actions.action("review.refresh").isEnabled()
    live.go("stack")
    assert live.actions.action("stack.start").isEnabled()
    assert not live.actions.action("review.refresh").isEnabled()
    assert live.actions.action("theme").isEnabled()


def test_a_change_of_theme_leaves_the_distances_on_the_jog_pads_whole(live, qtbot):
    live.window.resize(1280, 720)
    live.go("operate")
    jog = live.workspaces["operate"].page.jog
    jog.show_look(PoseReadout("X 1", 0.0, tuple((what, "146 mm") for what in jog.shown)))
    settle(live)
    before = [jog.pads[what].size() for what in jog.shown]
    for _ in THEMES:
        name = live.theme.tokens.name
        live.actions.action("theme").trigger()
        qtbot.waitUntil(lambda: live.theme.tokens.name != name, timeout=60_000)  # noqa: B023
        settle(live)
        pads = [jog.pads[what] for what in jog.shown]
        assert [pad.size() for pad in pads] == before
        assert all(pad.width() >= pad.minimumSizeHint().width() for pad in pads)
    live.look.show("dark", 1.0)


def test_buttons_and_fields_have_tooltips(live):
    page = live.workspaces["stack"].page
    run = page.run
    fields = (run.start, run.pause, run.cancel, *run.findChildren(QComboBox))
    for widget in (*live.window.rail.values(), live.bar.stop, page.decision.approve, *fields):
        assert widget.toolTip()


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("size", [(1280, 720), (1600, 940)])
def test_no_label_is_cut_off_and_the_top_bar_is_visible(live, bench, theme, size):
    live.look.show(theme, live.theme.scale)
    live.window.resize(*size)
    bench.tell_start()
    bench.tell_probe(1, (7.2, 3.1), -3.4)
    settle(live)
    assert (live.window.width(), live.window.height()) == size
    cut = [
        label.text()
        for label in live.window.findChildren(QLabel)
        if label.isVisible() and label.text() and not label.wordWrap()
        and label.sizePolicy().horizontalPolicy() is not label.sizePolicy().Policy.Ignored
        and label.width() < label.sizeHint().width() - 1
    ]  # fmt: skip
    assert cut == []
    window = QRect(live.window.rect())
    for widget in (
        live.bar.stop,
        live.bar.pill,
        *live.bar.chips.values(),
        live.workspaces["stack"].page.run.cancel,
    ):
        corner = widget.mapTo(live.window, widget.rect().bottomRight())
        assert window.contains(corner)


def test_scale_and_theme_switch_live(live, qtbot):
    before = live.bar.pill.sizeHint().height()
    refit, changes = live.look.refit, []
    live.look.refit = lambda: changes.append(live.theme.scale) or refit()
    live.actions.action("larger").trigger()
    live.actions.action("larger").trigger()
    # STOP must not wait behind one change of the whole window for each press.
    assert changes == []
    qtbot.waitUntil(lambda: bool(changes), timeout=60_000)
    assert changes == [pytest.approx(1.2)]
    assert live.bar.pill.sizeHint().height() > before
    names = []
    for _ in range(3):
        live.actions.action("theme").trigger()
        count = len(changes)
        qtbot.waitUntil(lambda: len(changes) > count, timeout=60_000)  # noqa: B023 - waited for here
        names.append(live.theme.tokens.name)
    assert sorted(names) == sorted(THEMES)
    live.look.show("dark", 1.0)


# -- settings --------------------------------------------------------------------------------------


def test_settings_survive_a_round_trip(tmp_path):
    path = tmp_path / "a" / "window.json"
    wanted = WindowSettings(
        "light",
        1.3,
        (10, 20, 1500, 900),
        "review",
        {"stack.pause": "Ctrl+P"},
        True,
        {"stack": {"seed": 9}},
    )
    save_settings(path, wanted)
    assert load_settings(path) == (wanted, "")


def test_no_file_is_no_warning(tmp_path):
    assert load_settings(tmp_path / "none.json") == (WindowSettings(), "")


@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", "null", '{"version": 1}', '{"version": 2, "theme": 5, "scale": "x"}',
     '{"version": 99}', '{"version": 2, "geometry": [1, 2]}',
     '{"version": 2, "scale": 1e9, "geometry": ["a", 1, 1, 1], "pages": []}',
     '{"version": 2, "keys": {"stack.pause": 7}}', '{"version": 2, "pages": {"stack": 5}}',
     '{"version": 2, "pages": [], "front": 4}',
     '{"version": 2, "geometry": [0, 0, 99999999, 1]}', "\udcff"],
)  # fmt: skip
def test_a_bad_file_never_prevents_the_start(tmp_path, content):
    path = tmp_path / "window.json"
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    settings, warning = load_settings(path)
    assert settings.theme == "dark"
    assert settings.scale == 1.0
    assert settings.geometry is None
    # The next change overwrites the file.
    save_settings(path, settings)
    (kept,) = tmp_path.glob("window-aside-*.json")
    assert kept.name in warning
    assert kept.read_bytes() == content.encode("utf-8", "surrogateescape")


def test_good_fields_of_a_partly_bad_file_are_kept(tmp_path):
    path = tmp_path / "window.json"
    body = {"version": 2, "theme": "light", "scale": 7,
            "pages": {"stack": {"piece": "barrel", "seed": "x"}}}  # fmt: skip
    path.write_text(json.dumps(body))
    settings, warning = load_settings(path)
    assert settings.theme == "light"
    assert "scale" in warning
    form, dropped = restore_form(RunForm(), settings.pages["stack"])
    assert (form.piece, form.seed, dropped) == ("barrel", RunForm().seed, ["seed"])


def test_closing_remembers_the_form(main, tmp_path):
    main.attach(StandInBench())
    main.workspaces["stack"].page.run.show_form(RunForm("mushroom", "circle25", seed=42))
    main.close()
    settings, _ = load_settings(tmp_path / "window.json")
    form, _ = restore_form(RunForm(), settings.pages["stack"])
    assert (form.piece, form.bottom, form.seed) == ("mushroom", "circle25", 42)


def test_closing_without_a_bench_keeps_the_remembered_form(qapp, tmp_path, qtbot):
    path, form = tmp_path / "window.json", RunForm("barrel", "hex20", "long", 5)
    save_settings(path, WindowSettings(pages={"stack": asdict(form)}))
    with opened(tmp_path):
        pass
    settings, _ = load_settings(path)
    assert restore_form(RunForm(), settings.pages["stack"])[0] == form


# -- guard and hooks -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("python", "pyside", "bad"),
    [((3, 11), "6.12.0", True), ((3, 12), "6.12.0", False), ((3, 13), "6.9.1", True),
     ((3, 11), "6.11.3", False)],
)  # fmt: skip
def test_the_guard_knows_the_bad_pairs(python, pyside, bad):
    line = incompatibility(python, pyside)
    assert (line is not None) == bad
    if line:
        assert pyside in line
        assert "pip install" in line


@pytest.mark.parametrize("absent", ["PySide6", "pyqtgraph"])
def test_without_qt_the_line_that_installs_it_is_printed(monkeypatch, capsys, absent):
    monkeypatch.setitem(sys.modules, absent, None)
    assert command_line.main([]) == 3
    assert 'pip install "touchdown[app]"' in capsys.readouterr().err
    assert touchdown_command(["app"]) == 3


def test_a_splash_says_what_goes_on_before_the_slow_imports(qapp, monkeypatch):
    told = []

    def run(_args, _application, splash):
        assert splash.isVisible()
        assert splash.windowHandle().isExposed()
        told.append(splash.message())
        splash.close()
        return 0

    monkeypatch.setitem(sys.modules, "touchdown.app.start", SimpleNamespace(run=run))
    assert command_line.main([]) == 0
    assert told == ["Touchdown\n\nLoading the program \N{HORIZONTAL ELLIPSIS}"]
    imports = "import sys, touchdown.app.splash; print({'numpy', 'pydantic'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", imports], capture_output=True, check=True)
    assert found.stdout.decode().strip() == "set()"


def test_the_splash_leaves_out_the_second_for_which_qt_waits(qapp):
    def shown_in_s():
        begun_s = time.monotonic()
        splash = Splash()
        splash.tell("Loading")
        splash.close()
        return time.monotonic() - begun_s

    # A busy computer delays some; Qt would delay all.
    assert any(shown_in_s() < 0.9 for _ in range(20))


def test_a_data_folder_that_cannot_be_written_is_told_at_the_start_and_in_collect(live):
    live.warn_unwritable(Path("/media/stick/touchdown"))
    card = live.cards.card("DATA-FOLDER").text
    assert "/media/stick/touchdown" in card.what
    assert "TOUCHDOWN_DATA" in card.next_step
    live.go("collect")
    label = live.workspaces["collect"].label
    label.session.person = "Ann"
    label._failed(OSError(errno.EROFS, "Read-only file system", "/media/stick/dataset.toml"))
    card = live.cards.card("DATASET").text
    assert card.what == "Read-only file system: /media/stick/dataset.toml"
    settle(live)
    live.workspaces["collect"].presenter.person = "Ann"
    settle(live)
    said = live.workspaces["collect"].collect_page.target.why_not.text()
    assert said == f"No dataset: {card.what}."


@pytest.mark.promise("P6", "W7")
def test_exceptions_of_slots_and_threads_and_qt_become_cards(main, qtbot):
    before = (sys.excepthook, threading.excepthook, sys.unraisablehook)
    restore = install_error_hooks(main._box)
    try:
        sys.excepthook(ValueError, ValueError("in a slot"), None)
        worker = threading.Thread(target=lambda: 1 / 0, name="lathe")
        worker.start()
        worker.join()
        qWarning("a layout complains")
    finally:
        restore()
    assert (sys.excepthook, threading.excepthook, sys.unraisablehook) == before
    settle(main)
    assert set(main.cards.codes) == {"BUG-VALUEERROR", "BUG-ZERODIVISIONERROR", "QT"}
    assert "lathe" in main.cards.card("BUG-ZERODIVISIONERROR").text.what
    assert "Traceback" in main.cards.card("BUG-ZERODIVISIONERROR").text.details
    main.cards.card("QT")._act()
    assert "QT" not in main.cards.codes


def test_a_log_that_cannot_be_written_is_no_obstacle(tmp_path):
    (tmp_path / "file").write_text("x")
    assert log_to(tmp_path / "file" / "log") is None
    assert ErrorBox().take() is None


def test_a_full_disk_is_told_at_the_start_and_not_on_the_terminal(tmp_path, monkeypatch, capsys):
    assert log_to(tmp_path / "log") is not None
    handler = log.handlers[-1]
    handler.stream.close()
    handler.stream = Path("/dev/full").open("w")  # noqa: SIM115
    log.error("a line that is lost")
    log.removeHandler(handler)
    assert capsys.readouterr().err == ""
    with pytest.raises(OSError, match="No space left"):
        handler.stream.close()
    # A full disk accepts an empty file.
    full = lambda dir: Path("/dev/full").open("wb")  # noqa: E731, SIM115
    monkeypatch.setattr("touchdown.backend.core.files.TemporaryFile", full)
    assert log_to(tmp_path / "log") is None


def test_the_rail_keeps_its_icons_in_place_whichever_page_is_in_front(live):
    def icon_columns(button):
        image = button.grab().toImage().convertToFormat(QImage.Format.Format_Grayscale8)
        rows = np.frombuffer(image.constBits(), np.uint8).reshape(image.height(), -1)
        top = rows[6:32, 5 : image.width() - 3].astype(int)
        drawn = np.flatnonzero((np.abs(top - np.median(top)) > 60).any(axis=0))
        return int(drawn[0]), int(drawn[-1])

    for name in live.workspaces:
        live.go(name)
        chosen = icon_columns(live.window.rail[name])
        live.go("stack" if name != "stack" else "operate")
        assert icon_columns(live.window.rail[name]) == pytest.approx(chosen, abs=1.1), name


@pytest.mark.promise("W7")
def test_details_are_shown_and_copied(live, bench, qapp):
    bench.tell_fault()
    settle(live)
    card = live.cards.card("FT-TRIP")
    card._copy()
    assert "FT-TRIP" in qapp.clipboard().text()
    assert card._details.isHidden()
    next(b for b in card.findChildren(QPushButton) if b.text() == "Details").click()
    assert not card._details.isHidden()


def test_the_override_of_the_bar_is_that_of_the_bench_and_hardware_starts_slowly(live, bench):
    assert live.bar.override.value() == 100
    live.actions.action("slower").trigger()
    assert bench.interlock.override == 0.9
    bench.simulated = False
    live.attach(bench)
    assert live.bar.override.value() == 10
    assert bench.interlock.override == 0.1
