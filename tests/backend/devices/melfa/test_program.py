"""The program for the controller fits the settings with which the driver starts it."""

import re
from pathlib import Path

from touchdown.backend.config.hardware import MelfaSettings

FOLDER = Path(__file__).resolve().parents[4] / "resources" / "melfa"


def test_the_program_opens_the_stream_that_the_driver_expects():
    wanted = MelfaSettings().mxt
    lines = (FOLDER / f"{wanted.program}.prg").read_text("ascii").splitlines()
    orders = [line for line in lines if line and not line.startswith("'")]
    assert orders[0] == "Servo On"
    assert re.fullmatch(r'Open "ENET:[0-9.]+" As #1', orders[1])
    assert orders[2] == f"Mxt 1,{wanted.position_type},10"
    assert orders[-1] == "End"
