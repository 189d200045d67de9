"""bench-v1 never changes: its values, its pieces, and the wrench of a press."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from touchdown.backend.config.bench_description import bench_sha256
from touchdown.backend.config.simulation import load_simulation
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.tower import Tower
from touchdown.backend.simulation.batch import BatchedTrials
from touchdown.backend.simulation.scene import Scene

BENCH = load_simulation(preset="bench-v1")
FILE = files("touchdown.resources") / "benches" / "bench-v1.toml"
VALUES = "03b08d28746d933930486411c27c1a07f9008dc6be3d42fb07d1c2279d5e443b"
PIECES = {
    "pot": "bdbb29d9d167befb",
    "barrel": "734642e984c6e208",
    "mushroom": "75769aa551146aea",
    "short": "cb3b06b48c966b79",
    "long": "c1c6ff05d8b3c9e5",
    "circle15": "bae46760ff60e620",
    "circle25": "3bd40b24fa4c0014",
    "square15": "e1f8c905bb454e8a",
}


def leaves(values: Mapping[str, Any], under: str = "") -> Iterator[str]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{under}{key}.")
        else:
            yield under + key


def test_no_value_ever_changes() -> None:
    assert bench_sha256(BENCH) == VALUES


def test_every_value_is_written_out_so_that_no_default_reaches_it() -> None:
    written = tomllib.loads(FILE.read_text("utf-8"))
    assert set(leaves(written)) == set(leaves(BENCH.model_dump()))


def test_the_pieces_of_the_tables_are_those_of_the_freezing() -> None:
    catalogue = load_pieces()
    named = {name: catalogue.piece(name).sha256[:16] for name in PIECES}
    assert named == PIECES


def test_a_press_on_it_feels_as_it_did() -> None:
    """Pot on Long, beyond its middle: one piece slips in the grip, the other makes Long rock."""
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("long").body(),))
    bench = BatchedTrials(
        [Scene(catalogue.top("pot"), tower, (0.0, 0.0), seed, BENCH) for seed in (13, 18)]
    )
    felt = bench.press([0, 1], np.full((2, 2), (8.0, -4.0)))
    assert felt.valid.all()
    assert felt.slip_mm == pytest.approx([0.1786, 0.0], abs=5e-4)
    assert felt.true_mm == pytest.approx(np.array([[6.1775, -3.9204], [6.8473, -4.1607]]), abs=5e-4)
    force_n = [[0.4428, 0.9031, 8.0413], [0.8975, -0.9690, 7.4345]]
    moment_nm = [[0.0504, -0.0839, 0.0082], [0.0579, -0.1015, -0.0079]]
    markers_px = [[-0.116, -9.962, -9.977], [-0.249, -10.008, -12.014]]
    assert felt.observation[:, -1, -6:-3] == pytest.approx(np.array(force_n), abs=2e-3)
    assert felt.observation[:, -1, -3:] == pytest.approx(np.array(moment_nm), abs=2e-4)
    assert felt.observation[:, -1, [0, 100, 200]] == pytest.approx(np.array(markers_px), abs=5e-3)
