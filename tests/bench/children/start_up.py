"""Child of the start-up figures: from the command to live pictures, cold and with warm imports.

Prints one JSON object. Cold counts from the start of this process; the second window of the same
process finds every module imported.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import psutil
from PySide6.QtCore import QDeadlineTimer, QEventLoop
from PySide6.QtWidgets import QApplication

from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox
from touchdown.app.start import open_simulated_bench

MOST_MS = 60_000


def main() -> int:
    application = QApplication([])
    with tempfile.TemporaryDirectory() as folder:
        _to_live(application, Path(folder))
        cold_s = time.time() - psutil.Process().create_time()
        warm_s = _to_live(application, Path(folder))
    sys.stdout.write(json.dumps({"cold_s": round(cold_s, 2), "warm_s": round(warm_s, 2)}) + "\n")
    return 0


def _to_live(application: QApplication, folder: Path) -> float:
    """Return the seconds until both fingers and the traces are drawn."""
    begun_s = time.monotonic()
    main = TouchdownApp(application, ErrorBox(), folder / "window.json", folder / "runs")
    main.start()
    main.go("operate")
    main.connect_bench(open_simulated_bench)
    operate, until = main.workspaces["operate"], QDeadlineTimer(MOST_MS)
    while not until.hasExpired():
        application.processEvents(QEventLoop.ProcessEventsFlag.WaitForMoreEvents, 20)
        live = operate.live
        if live is not None and min(live.frames_shown.values()) and operate.page.force.paints:
            break
    taken_s = time.monotonic() - begun_s
    main.quit_at_once()
    main.close()
    main.window.deleteLater()
    main.deleteLater()
    application.processEvents()
    return taken_s


if __name__ == "__main__":
    sys.exit(main())
