"""The batch simulation and the device path give the model the same input (see ``one_press``)."""

from __future__ import annotations

import numpy as np
import pytest

from tests.backend.one_press import CASES, RMS_LIMIT_PX, press_both_ways
from touchdown.backend.core.values import TACTILE_CHANNELS


@pytest.mark.parametrize(("piece", "bottom", "seed"), CASES)
def test_one_press_felt_by_the_devices_is_the_one_simulated_in_bulk(
    piece: str, bottom: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    press = press_both_ways(piece, bottom, seed, monkeypatch)
    assert press.computed_mm == pytest.approx(press.felt_mm, abs=0.05)
    moved_px = float(np.sqrt(np.mean(press.computed[:, :TACTILE_CHANNELS] ** 2)))
    assert moved_px > 2.0
    assert press.rms_px <= RMS_LIMIT_PX
    wrench = np.abs(press.felt - press.computed)[:, TACTILE_CHANNELS:]
    assert wrench[:, :3].max() < 0.15
    assert wrench[:, 3:].max() < 0.01
