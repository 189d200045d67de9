"""Frozen benches never change: their values, their pieces, and the wrench of a press."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.backend.config import (
    PRESETS,
    ProbeSettings,
    SimulationSettings,
    SurfaceSettings,
    bench_sha256,
    load_simulation,
)
from touchdown.backend.config.simulation import LATER_KEYS
from touchdown.backend.core import InputError
from touchdown.backend.core.marker_interpolation import fill_unseen_markers
from touchdown.backend.experiments import tables
from touchdown.backend.experiments.strategies import BOTTOMS, FRESH, SINGLE_BOTTOMS
from touchdown.backend.experiments.trials import grasped_piece_in
from touchdown.backend.geometry import Surface, Tower, face_points, load_pieces, true_patch
from touchdown.backend.simulation import batch as batch_module
from touchdown.backend.simulation import conditions, marker_fields, mechanics
from touchdown.backend.simulation.batch import (
    TARE_HEIGHT_MM,
    BatchedTrials,
    BatchPlan,
    EpisodeBatch,
    simulate_episodes,
)
from touchdown.backend.simulation.conditions import SeedScope
from touchdown.backend.simulation.gripper import HeldPiece
from touchdown.backend.simulation.ground_truth import Scene, scene_mounting, tower_with_piece
from touchdown.backend.simulation.pressing import PressBatch
from touchdown.backend.simulation.world import World
from touchdown.backend.simulation.wrist_sensor import WristLoad, WristSampler, wrist_wrench

BENCH = load_simulation(preset="bench-v1")
SECOND = load_simulation(preset="bench-v2")
BENCHES = files("touchdown.resources") / "benches"
VALUES = {
    "bench-v1": "03b08d28746d933930486411c27c1a07f9008dc6be3d42fb07d1c2279d5e443b",
    "bench-v2": "e3fecfeee9723b6f4b4a06403c9c5cc1d089375d7325f1e354ecde6a2466934e",
}
PIECES = {
    "pot": "bdbb29d9d167befb",
    "barrel": "734642e984c6e208",
    "mushroom": "75769aa551146aea",
    "short": "cb3b06b48c966b79",
    "long": "c1c6ff05d8b3c9e5",
    "circle15": "bae46760ff60e620",
    "circle25": "3bd40b24fa4c0014",
    "square15": "e1f8c905bb454e8a",
    "hex20": "11eedae9e3e1dab3",
    "rect12x28": "8167a6a5890c3992",
}


def leaves(values: Mapping[str, Any], under: str = "") -> Iterator[str]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{under}{key}.")
        else:
            yield under + key


@pytest.mark.parametrize("name", VALUES)
def test_no_value_ever_changes(name: str) -> None:
    assert bench_sha256(load_simulation(preset=name)) == VALUES[name]
    assert f"`{VALUES[name]}`" in Path(f"docs/{name}.md").read_text("utf-8")


def test_bench_v2_has_a_variant_with_faces_that_are_not_flat() -> None:
    uneven = load_simulation(Path(str(BENCHES / "bench-v2-surfaces.toml")))
    sha256 = "5abbe7ba9b9cfd3ff86cd6fb6d311de43f0269e49e15a669861c55e44054363d"
    assert bench_sha256(uneven) == sha256
    assert f"`{sha256}`" in Path("docs/bench-v2.md").read_text("utf-8")
    assert uneven.model_copy(update={"surface": SECOND.surface}) == SECOND


@pytest.mark.parametrize("name", VALUES)
def test_every_value_is_written_out_so_that_no_default_reaches_it(name: str) -> None:
    written = tomllib.loads((BENCHES / f"{name}.toml").read_text("utf-8"))
    # Whole cells are left out of the hash, which is older than the choice.
    dumped = load_simulation(preset=name).model_dump()
    assert set(leaves(written)) == {*leaves(dumped), "face.subcells"}
    assert written["face"]["subcells"] == {"bench-v1": 1, "bench-v2": 3}[name]


def test_an_effect_switched_off_stays_off_in_the_stored_form() -> None:
    later = {f"{section}.{key}" for section, keys in LATER_KEYS.items() for key in keys}
    for preset in PRESETS:
        bench = load_simulation(preset=preset)
        assert later.isdisjoint(leaves(bench.model_dump())) == (preset != "bench-v2")
    changed = {"preset": "bench-v2", "spread": {"com_mm": 0.0}, "face": {"subcells": 1}}
    bench = SimulationSettings.model_validate(changed)
    assert SimulationSettings.model_validate(bench.model_dump(mode="json")) == bench


def test_the_draws_of_bench_v2_leave_the_others_as_they_are() -> None:
    spread = SECOND.spread.model_copy(
        update=dict.fromkeys((*conditions.DAY_SPREADS, *conditions.SEAT_SPREADS), 0.0)
    )
    without = SECOND.model_copy(update={"spread": spread})
    for draw in (conditions.draw_mounting, conditions.draw_probe):
        streams = [np.random.default_rng(5) for _ in range(2)]
        more, less = draw(SECOND, streams[0]), draw(without, streams[1])
        assert streams[0].random() == streams[1].random()
        changed = {
            f.name for f in fields(more)
            if not np.array_equal(getattr(more, f.name), getattr(less, f.name))
        }  # fmt: skip
        assert changed == {
            "draw_mounting": {
                "face_tilt_rad", "crown_rad", "com_mm", "pad_area", "wrist_yaw_rad",
                "wrist_lever_mm", "cable_n_mm",
            },
            "draw_probe": {"reseat_mm", "pitch_rad"},
        }[draw.__name__]  # fmt: skip


def test_a_pitched_piece_tilts_and_moves_its_face_and_a_wider_one_fills_the_pads() -> None:
    settings = SimulationSettings(preset="off")
    rng = np.random.default_rng(0)
    mounting = replace(
        conditions.draw_mounting(settings, rng), face_tilt_rad=(0.002, 0.001), pad_area=1.21
    )
    probe = replace(
        conditions.draw_probe(settings, rng), reseat_mm=(0.2, -0.1), pitch_rad=0.004
    )  # fmt: skip
    grip = conditions.draw_gripping(settings, 10.0, rng)
    made = conditions.conditions_from_draws(
        settings, ProbeSettings(), 30.0, 30.0, [(mounting, grip, probe)]
    )
    assert made.tilt_rad[0] == pytest.approx([0.002, 0.005])
    assert made.grasp_offset_mm[0] == pytest.approx([0.2 + 0.004 * 30.0, -0.1])
    assert made.shear_n_mm[0] == pytest.approx(1.21 * 4.0)
    assert made.torsion_nmm[0] == pytest.approx(1.21**2 * 128.0)
    assert made.limit_radius_mm[0] == pytest.approx(1.1 * 3.8)
    sized = SimulationSettings.model_validate({"preset": "off", "grasp": {"pad_width_mm": 15.0}})
    mounting = replace(mounting, pad_area=1.0)
    made = conditions.conditions_from_draws(
        sized, ProbeSettings(), 30.0, 30.0, [(mounting, grip, probe)]
    )
    assert made.shear_n_mm[0] == pytest.approx(2**0.5 * 4.0)


def second(**changes) -> Scene:
    catalogue = load_pieces()
    settings = SimulationSettings.model_validate({"preset": "bench-v2", **changes})
    tower = Tower((catalogue.bottom("long").body(),))
    return Scene(catalogue.top("mug"), tower, (1.0, 2.0), 3, settings)


def test_the_judge_knows_the_true_centre_of_mass_and_the_method_the_entered_one() -> None:
    scene = second()
    error = scene_mounting(scene).com_mm
    assert 0.05 < np.hypot(*error) < 2.5
    entered = scene.piece.com_xy_mm
    judged = tower_with_piece(scene, (1.0, 2.0), 0.0).bodies[-1]
    assert judged.com_xy_mm == pytest.approx(np.add(entered, error))
    assert grasped_piece_in(scene, None).com_xy_mm == entered
    exact = second(spread={"com_mm": 0.0})
    assert tower_with_piece(exact, (1.0, 2.0), 0.0).bodies[-1].com_xy_mm == entered
    weight = HeldPiece(scene, 0, 10.0).weight.position_mm
    plain_weight = HeldPiece(exact, 0, 10.0).weight.position_mm
    assert np.subtract(weight, plain_weight)[:2] == pytest.approx(error)


def test_batch_and_devices_draw_the_same_press_of_bench_v2() -> None:
    scene = second()
    bench, held = BatchedTrials([scene]), HeldPiece(scene, 0, 10.0)
    for _ in range(2):
        ours = bench._conditions(np.array([0]))
        held.begin_probe(ProbeSettings())
        for name in ours.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(ours, name), getattr(held.conditions, name))
        assert held.touch_height_mm == scene.grip_height_mm + ours.grasp_offset_mm[0, 1]


def test_cables_and_sensor_place_change_only_the_wrench_of_a_press() -> None:
    off = {"cable_n_mm": 0.0, "wrist_yaw_rad": 0.0, "wrist_lever_mm": 0.0}
    scenes = second(spread=off), second()
    plain, real = (BatchedTrials([s]).press([0], np.array([[4.0, 1.0]])) for s in scenes)
    np.testing.assert_array_equal(plain.truth.offset_mm, real.truth.offset_mm)
    np.testing.assert_array_equal(plain.observation[..., :-6], real.observation[..., :-6])
    day = scene_mounting(scenes[1])
    moved = np.zeros((20, 3))
    moved[:, 2] = -TARE_HEIGHT_MM - real.travel_mm[0]
    pull = moved @ np.array(day.cable_n_mm).T
    force = plain.observation[0, :, -6:-3].astype(np.float64)
    turned = wrist_wrench(np.c_[force + pull, np.zeros((20, 3))], 0.0, day.wrist_yaw_rad)[:, :3]
    difference = np.abs(turned - real.observation[0, :, -6:-3]).max()
    assert difference < 0.02 < np.abs(force - real.observation[0, :, -6:-3]).max()


def test_the_samples_of_a_cycle_lead_from_one_load_to_the_next_at_the_sensor() -> None:
    silent = dict.fromkeys(("white_n", "white_nm", "drift_n_sqrt_min", "drift_nm_sqrt_min"), 0.0)
    settings = SimulationSettings().wrist.model_copy(update=silent)
    yaw_rad, lever_mm = 0.03, (1.0, -2.0, 3.0)
    sampler = WristSampler(settings, 10_000, 1, yaw_rad, lever_mm)
    before, after = np.arange(6.0) - 2.0, np.arange(6.0)[::-1] * 1.5
    t_s, values = sampler.samples(0, 10_000, WristLoad(before, after, np.full(6, 0.1)))
    shares = (t_s / 0.01)[:, None]
    loads = before + shares * (after - before)
    place = settings.height_mm, settings.yaw_rad + yaw_rad, np.array(lever_mm)
    np.testing.assert_allclose(values, wrist_wrench(loads, *place) + 0.1, atol=1e-9)


def test_the_field_of_jaws_without_a_piece_follows_their_forces() -> None:
    world = World(second())
    still = world._field(world._rest)
    world.jaws.force_n, world.jaws.asked_n = 8.0, 10.0
    pressed = world._field(world._rest)
    assert np.abs(pressed - still).max() > 0.1
    world.jaws.asked_n = 20.0
    assert np.abs(world._field(world._rest) - pressed).max() > 0.1


def test_the_stepped_world_feels_cables_and_sensor_place() -> None:
    scene = second()
    day, world = scene_mounting(scene), World(scene)
    assert world._wrist._yaw_rad == day.wrist_yaw_rad
    assert tuple(world._wrist._lever_mm) == day.wrist_lever_mm
    still = world._load(np.zeros(14))
    world._cable_from_mm = world.drive.command_mm - np.array([5.0, 0.0, -2.0])
    force = np.array(day.cable_n_mm) @ [5.0, 0.0, -2.0]
    felt = world._load(np.zeros(14)) - still
    np.testing.assert_allclose(felt, [*force, -60.0 * force[1], 60.0 * force[0], 0.0], atol=1e-9)


def test_the_pieces_of_the_tables_are_those_of_the_freezing() -> None:
    """Every piece and bottom of a table or comparison is among them."""
    used = {*tables.PIECES, *tables.TRAINING_BOTTOMS, *SINGLE_BOTTOMS}
    used |= {name for tower in BOTTOMS for name in tower.split("+")}
    assert used - {FRESH} == set(PIECES)
    catalogue = load_pieces()
    named = {name: catalogue.piece(name).sha256[:16] for name in PIECES}
    assert named == PIECES


def test_a_press_on_it_feels_as_it_did(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pot on Long, beyond its middle: one piece slips in the grip, the other makes Long rock.

    With the draws of the freezing, in whose seeds piece and bottom had no part.
    """

    def drawn_alike(seed: int, scope: SeedScope, scene: int, *place: int) -> np.random.Generator:
        return np.random.default_rng([seed, scope, *place])

    monkeypatch.setattr(conditions, "scoped_generator", drawn_alike)
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("long").body(),))
    bench = BatchedTrials(
        [Scene(catalogue.top("pot"), tower, (0.0, 0.0), seed, BENCH) for seed in (13, 18)]
    )
    felt = bench.press([0, 1], np.full((2, 2), (8.0, -4.0)))
    assert (felt.detected & felt.truth.solved).all()
    assert felt.truth.slip_mm == pytest.approx([0.1786, 0.0], abs=5e-4)
    assert felt.truth.offset_mm == pytest.approx(
        np.array([[6.1775, -3.9204], [6.8473, -4.1607]]), abs=5e-4
    )
    force_n = [[0.4428, 0.9031, 8.0413], [0.8975, -0.9690, 7.4345]]
    moment_nm = [[0.0504, -0.0839, 0.0082], [0.0579, -0.1015, -0.0079]]
    markers_px = [[-0.116, -9.962, -9.977], [-0.249, -10.008, -12.014]]
    assert felt.observation[:, -1, -6:-3] == pytest.approx(np.array(force_n), abs=2e-3)
    assert felt.observation[:, -1, -3:] == pytest.approx(np.array(moment_nm), abs=2e-4)
    assert felt.observation[:, -1, [0, 100, 200]] == pytest.approx(np.array(markers_px), abs=5e-3)


def test_a_press_on_bench_v2_feels_as_it_did() -> None:
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("long").body(),))
    bench = BatchedTrials(
        [Scene(catalogue.top("pot"), tower, (0.0, 0.0), seed, SECOND) for seed in (3, 4)]
    )
    felt = bench.press([0, 1], np.full((2, 2), (5.0, -3.0)))
    assert felt.truth.offset_mm == pytest.approx(
        np.array([[5.0023, -2.8388], [7.0583, -3.0649]]), abs=5e-4
    )
    force_n = [[0.7500, -0.0238, 5.8044], [1.1494, -0.7708, 7.3611]]
    moment_nm = [[-0.0802, -0.0730, -0.0095], [-0.0435, -0.1092, -0.0054]]
    assert felt.observation[:, -1, -6:-3] == pytest.approx(np.array(force_n), abs=2e-3)
    assert felt.observation[:, -1, -3:] == pytest.approx(np.array(moment_nm), abs=2e-4)
    markers_px = [[0.804, -11.953, -13.472], [0.468, -11.247, -11.588]]
    assert felt.observation[:, -1, [0, 100, 200]] == pytest.approx(np.array(markers_px), abs=5e-3)


def plan(piece: str = "pot", bottom: str = "circle25", **changes) -> BatchPlan:
    catalogue = load_pieces()
    top, below = catalogue.top(piece), catalogue.bottom(bottom)
    made = BatchPlan(
        piece=piece,
        bottom=bottom,
        face=top.face,
        bottom_outline=below.upper,
        face_points_mm=face_points(top.face),
        grip_height_mm=top.grip_height_mm,
        width_mm=top.width_mm,
        episodes=24,
        seed=5,
        probes_per_grip=4,
        grips_per_mounting=3,
    )
    return replace(made, **changes)


def everything(batches) -> EpisodeBatch:
    parts = list(batches)
    counts = ("rejected", "unsolved")
    names = [n for n in EpisodeBatch.__dataclass_fields__ if n not in counts]
    order = np.argsort(np.concatenate([b.episode for b in parts]))
    whole = {n: np.concatenate([getattr(b, n) for b in parts])[order] for n in names}
    return EpisodeBatch(**whole, **{n: sum(getattr(b, n) for b in parts) for n in counts})


@pytest.fixture(scope="module")
def default_batch() -> EpisodeBatch:
    return everything(simulate_episodes(plan()))


def test_episodes_have_the_promised_shapes_and_scopes(default_batch) -> None:
    batch = default_batch
    assert batch.observation.shape == (24, 20, 258)
    assert batch.observation.dtype == np.float32
    assert np.isfinite(batch.observation).all()
    np.testing.assert_array_equal(batch.episode, np.arange(24))
    np.testing.assert_array_equal(batch.grip, np.arange(24) // 4)
    np.testing.assert_array_equal(batch.mounting, batch.grip // 3)
    assert batch.residual.max() <= 1e-4


def test_the_label_is_the_overlap_at_the_commanded_place(default_batch) -> None:
    made = plan()
    patch = true_patch(made.face_points_mm, default_batch.offset_mm, made.bottom_outline)
    np.testing.assert_array_equal(default_batch.patch, patch)
    assert default_batch.patch.sum(axis=1).min() >= 6


def test_the_face_sits_at_commanded_minus_grasp_offset_within_one_grip(default_batch) -> None:
    made = plan()
    for grip in range(6):
        rows = default_batch.grip == grip
        seed = conditions.scoped_generator(5, SeedScope.GRIPPING, made.pair, grip // 3, grip)
        g_x = conditions.draw_gripping(made.settings, 10.0, seed).grasp_offset_mm[0]
        seed = conditions.scoped_generator(5, SeedScope.MOUNTING, made.pair, grip // 3)
        board = conditions.draw_mounting(made.settings, seed).print_offset_mm
        shift = default_batch.true_offset_mm[rows] - default_batch.offset_mm[rows]
        # What is left is the arm's own error of each probe.
        rest = shift + np.array([g_x, 0.0]) + np.array(board)
        assert np.abs(rest).max() < 0.3
        assert np.ptp(rest[:, 0]) > 0.0


def test_same_seed_same_bytes_however_the_grips_are_shared_out(default_batch) -> None:
    shared = everything(
        [*simulate_episodes(plan(), [3, 4, 5]), *simulate_episodes(plan(), [0, 1, 2])]
    )
    again = everything(
        [*simulate_episodes(plan(), [0, 1, 2]), *simulate_episodes(plan(), [3, 4, 5])]
    )
    assert shared.observation.tobytes() == again.observation.tobytes()
    np.testing.assert_allclose(shared.observation, default_batch.observation, atol=1e-3)
    other = everything(simulate_episodes(plan(seed=6), [0]))
    assert np.abs(other.observation - default_batch.observation[:4]).max() > 0.1


def test_without_noise_equal_offsets_give_the_pure_physics() -> None:
    made = plan(settings=load_simulation(preset="off"), episodes=6, probes_per_grip=1)
    batch = everything(simulate_episodes(made))
    np.testing.assert_allclose(batch.true_offset_mm, batch.offset_mm)
    end = batch.observation[:, -1]
    assert np.ptp(end[:, 254]) < 1.0
    assert (end[:, 254] > 6.5).all()
    field = end[:, :252].reshape(6, 2, 2, 7, 9)
    # Both cameras see the piece rise (v falls), mirrored along u.
    assert (field[:, :, 1, 3, 4] < -14.0).all()
    np.testing.assert_allclose(field[:, 0, 0, 3, 4], -field[:, 1, 0, 3, 4], atol=0.35)


def test_added_errors_have_the_levels_of_the_settings() -> None:
    quiet_physics = load_simulation(preset="off").model_copy(
        update={"wrist": SimulationSettings().wrist, "tactile": SimulationSettings().tactile}
    )
    count = 150
    noisy = plan(settings=quiet_physics, episodes=count, probes_per_grip=1)
    batch = everything(simulate_episodes(noisy))
    clean_settings = load_simulation(preset="off")
    clean = everything(simulate_episodes(replace(noisy, settings=clean_settings)))
    np.testing.assert_allclose(batch.offset_mm, clean.offset_mm)
    error = batch.observation.astype(float)[:, 16:] - clean.observation.astype(float)[:, 16:]
    held = error.mean(axis=1)
    force_sd = held[:, [252, 253]].std()
    assert force_sd == pytest.approx(0.2, rel=0.2)
    assert held[:, 255:].std() == pytest.approx(0.008, rel=0.25)
    within = error[:, :, 252:254] - error[:, :, 252:254].mean(axis=1, keepdims=True)
    assert within.std() == pytest.approx(0.01, rel=0.35)
    field = error[:, :, :252].reshape(count, 4, 2, 2, 63)
    bias = field.mean(axis=(1, 4))
    assert bias[:, :, 0].std() == pytest.approx(0.155, rel=0.2)
    white = field - field.mean(axis=4, keepdims=True)
    # Interpolation between two frames averages part of the white noise away.
    assert 0.02 < np.median(np.abs(white)) / 0.6745 < 0.05


def test_slip_is_carried_within_a_grip_and_reported() -> None:
    hard = load_simulation(preset="hard").model_copy(update={"mu_grip": 0.36})
    batch = everything(
        simulate_episodes(
            plan("mushroom", "circle15", settings=hard, episodes=24, probes_per_grip=4)
        )
    )
    assert (batch.slip_mm > 0.02).mean() > 0.5
    still = hard.model_copy(update={"grasp": hard.grasp.model_copy(update={"slip": False})})
    without = everything(
        simulate_episodes(
            plan("mushroom", "circle15", settings=still, episodes=24, probes_per_grip=4)
        )
    )
    assert not without.slip_mm.any()
    moved = np.abs(batch.true_offset_mm - without.true_offset_mm).max(axis=1)
    first = batch.episode % 4 == 0
    assert moved[first].max() < 1e-12
    assert moved[~first].max() > 1e-3


def test_probes_that_miss_are_drawn_again_and_counted() -> None:
    wide = SimulationSettings.model_validate({"spread": {"grasp_offset_mm": 1.5}})
    made = plan("pot", "circle15", settings=wide, episodes=400, probes_per_grip=1, seed=2)
    batch = everything(simulate_episodes(made))
    assert len(batch.episode) == 400
    assert 0 < batch.rejected < 40
    assert batch.unsolved < batch.rejected


def test_a_press_without_a_balance_is_drawn_again_and_counted_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is an error of the simulation; a miss is an observation."""
    real, calls = batch_module.usable_presses, []

    def once_unsolved(pressed: PressBatch, *others: Any) -> np.ndarray:
        calls.append(len(pressed.detected))
        good = real(pressed, *others)
        if len(calls) == 1:
            good[0], pressed.detected[0] = False, True
            good[1], pressed.detected[1] = False, False
        return good

    monkeypatch.setattr(batch_module, "usable_presses", once_unsolved)
    made = plan("pot", "circle15", episodes=4, probes_per_grip=1)
    batch = everything(simulate_episodes(made))
    assert (batch.rejected, batch.unsolved, calls[:2]) == (2, 1, [4, 2])


def test_a_gripping_stays_the_same_and_the_next_differs() -> None:
    settings = SimulationSettings()
    draws = [
        conditions.draw_gripping(
            settings, 10.0, conditions.scoped_generator(1, SeedScope.GRIPPING, 0, grip)
        )
        for grip in (0, 0, 1)
    ]
    assert draws[0] == draws[1]
    assert draws[0] != draws[2]


def test_draws_keep_their_limits() -> None:
    wild = SimulationSettings.model_validate(
        {"spread": {"gel": 5.0, "mu": 5.0, "tilt_rad": 1.0, "gain": 9.0}}
    )
    rng = np.random.default_rng(0)
    for _ in range(50):
        grip = conditions.draw_gripping(wild, 10.0, rng)
        assert 0.7 <= grip.gel_factor <= 1.3
        assert all(0.8 <= gain <= 1.2 for gain in grip.gain)
        assert np.abs(conditions.draw_mounting(wild, rng).tilt_rad).max() <= 0.02
        assert 0.2 <= conditions.draw_probe(wild, rng).mu <= 0.6


@pytest.mark.promise("C5")
def test_frames_round_a_tick_skip_those_that_were_dropped() -> None:
    t_s = np.full((1, 2, 72), np.inf)
    t_s[0, :, :60] = 0.04 * np.arange(60)
    t_s[0, 0, 26] = np.inf
    ticks = np.full((1, 20), 1.03)
    index, weight = marker_fields.frames_around_ticks(t_s, ticks)
    assert index[0, 0, 0].tolist() == [25, 27]
    assert index[0, 1, 0].tolist() == [25, 26]
    np.testing.assert_allclose(weight[0, 0, 0], [0.625, 0.375])
    np.testing.assert_allclose(weight[0, 1, 0], [0.25, 0.75])


def test_lost_markers_follow_the_set_share_in_bursts() -> None:
    tactile = SimulationSettings().tactile.model_copy(update={"lost_share": 0.01})
    lost = np.stack(
        [marker_fields.draw_camera(tactile, np.random.default_rng(k)).lost for k in range(60)]
    )
    assert lost.mean() == pytest.approx(0.01, rel=0.2)


def test_lost_markers_are_filled_in(monkeypatch: pytest.MonkeyPatch) -> None:
    losing = SimulationSettings.model_validate({"preset": "off", "tactile": {"lost_share": 0.02}})
    made = plan(settings=losing, episodes=8, probes_per_grip=1)
    asked = []

    def infer(field, seen):
        asked.append((~seen).sum())
        return fill_unseen_markers(field, seen)

    monkeypatch.setattr(marker_fields, "fill_unseen_markers", infer)
    filled = everything(simulate_episodes(made))
    whole = everything(simulate_episodes(replace(made, settings=load_simulation(preset="off"))))
    assert sum(asked) > 0
    error = (filled.observation - whole.observation)[:, :, :252]
    assert np.abs(error).max() < 1.5
    assert np.count_nonzero(np.abs(error) > 1e-4) > 0


BENT = BENCH.model_copy(update={"surface": SurfaceSettings(tilted_share=0.5, stepped_share=0.4)})


def bent_scene(seed: int, settings: SimulationSettings = BENT) -> Scene:
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("short").body(),))
    return Scene(catalogue.top("pot"), tower, (4.0, 0.0), seed, settings)


def test_a_scene_draws_the_face_of_its_bottom_and_nothing_else_changes() -> None:
    surfaces = [bent_scene(seed).bottoms.bodies[-1].surface for seed in range(60)]
    assert len(set(surfaces)) > 50
    assert 15 < sum(bool(any(s.tilt_rad)) for s in surfaces) < 45
    assert max(np.hypot(*s.tilt_rad) for s in surfaces) <= 0.0524
    assert max(s.step_mm for s in surfaces) <= 1.0
    assert sum(s.flat for s in surfaces) < 20
    bent, flat = bent_scene(3), bent_scene(3, BENCH)
    assert bent_scene(3) == bent
    assert replace(bent, mounting=1).bottoms == bent.bottoms
    assert flat.bottoms.bodies[-1].surface.flat
    assert scene_mounting(bent) == scene_mounting(flat)
    assert HeldPiece(bent, 0, 10.0).gripping == HeldPiece(flat, 0, 10.0).gripping
    # A bottom with a surface of its own keeps it.
    own = replace(flat.bottoms.bodies[-1], surface=Surface(dome_mm=300.0))
    assert replace(bent, bottoms=Tower((own,))).bottoms.bodies == (own,)


def test_a_bent_bottom_below_another_is_refused() -> None:
    scene = bent_scene(3)
    with pytest.raises(InputError, match="not flat"):
        replace(scene, bottoms=scene.bottoms.with_top(scene.bottoms.bodies[0]))


def test_devices_and_batch_touch_the_face_of_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = bent_scene(3)
    touched: list[Any] = []
    begin = mechanics.begin_probes

    def note(*args: Any, surfaces: Any = None, **rest: Any) -> Any:
        touched.append(tuple(surfaces if surfaces is not None else args[7]))
        return begin(*args, **({"surfaces": surfaces} if surfaces is not None else {}), **rest)

    monkeypatch.setattr(mechanics, "begin_probes", note)
    monkeypatch.setattr("touchdown.backend.simulation.batch.begin_probes", note)
    held = HeldPiece(scene, 0, 10.0)
    held.solve(np.array([0.0, 0.0, held.touch_height_mm]), 0.01)
    trials = BatchedTrials([scene])
    trials.press([0], trials.start_commands_mm())
    assert touched == 2 * [(scene.bottoms.bodies[-1].surface,)]


def test_every_mounting_of_a_collection_has_a_face_of_its_own() -> None:
    made = plan(settings=BENT, grips_per_mounting=2)
    bench = batch_module._BatchBench(made)
    drawn = [bench.surface(grip) for grip in range(8)]
    assert drawn[0::2] == drawn[1::2]
    assert len(set(drawn[0::2])) == 4
