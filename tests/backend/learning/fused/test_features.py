"""Learned fusion: the same network with and without torch, signals that mirror as the bench does,
insets as geometry has them, weights that arrive whole, and a training that learns.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tests.backend.learning.fused.fused_writer import NAME, write
from touchdown.backend.config.simulation import load_simulation
from touchdown.backend.core.faults import InputError
from touchdown.backend.experiments import oracle
from touchdown.backend.experiments.oracle import HypothesisEnsemble, OracleSetting, predict_press
from touchdown.backend.geometry import circle, face_points, inset_mm, load_pieces, rectangle
from touchdown.backend.learning.checkpoint import save_checkpoint
from touchdown.backend.learning.fused.checkpoint import (
    FusedCard,
    FusedCheckpoint,
    join_networks,
    load_fused,
)
from touchdown.backend.learning.fused.features import (
    MIRRORS,
    TICKS,
    FusedShape,
    GraspedFace,
    acting_point_mm,
    expected_fused_arrays,
    field_components,
    mirror_signals,
    probe_inputs,
    shared_arrays,
)
from touchdown.backend.learning.fused.inference import FusedForward, InsetDistribution, point_inputs
from touchdown.backend.learning.fused.training import (
    FusedNet,
    FusedTrainer,
    FusedTraining,
    ProbeSequences,
    checkpoint_arrays,
    prepare_sequences,
)
from touchdown.backend.simulation.marker_fields import build_gel
from touchdown.backend.simulation.mechanics import GraspHistory

SMALL = FusedShape(width=16, heads=2, layers=2, inner=24, parts=2)
FACE = GraspedFace.of(face_points(circle(15.0)), np.array([0.5, -1.0]), np.array(30.0))
Arrays = dict[str, NDArray[Any]]


def signals(rng: np.random.Generator, count: int) -> tuple[NDArray[np.float32], ...]:
    wrench = rng.normal(size=(count, 8, 6)).astype(np.float32)
    return wrench, rng.normal(size=(count, 8, 252)).astype(np.float32)


def weights(seed: int) -> dict[str, NDArray[np.float32]]:
    """Random ones: the network's own, a scaling, and marker fields."""
    rng = np.random.default_rng(seed)
    sizes = expected_fused_arrays(SMALL)
    about = {
        "mean": rng.normal(size=sizes["mean"]),
        "scale": rng.uniform(0.5, 2.0, sizes["scale"]),
        "modes": rng.normal(size=sizes["modes"]),
    }
    net = {name: value.numpy() for name, value in checkpoint_arrays(FusedNet(SMALL, seed)).items()}
    biases = {n: rng.normal(size=a.shape) for n, a in net.items() if n.endswith("bias")}
    return {
        name: np.asarray(array, np.float32) for name, array in {**about, **net, **biases}.items()
    }


def test_without_torch_the_network_answers_as_with_it() -> None:
    rng, arrays = np.random.default_rng(1), weights(1)
    wrench, field = signals(rng, 4)
    offset, points = rng.normal(size=(4, 2)), 5.0 * rng.normal(size=(7, 2))
    forward = FusedForward(arrays, SMALL)
    known = forward.known(wrench, field, offset, FACE)
    found = forward.inset(known[-1:], points, offset[-1] - offset[0])

    net = FusedNet(SMALL, 0)
    for key in net.weights:
        net.weights[key] = torch.nn.Parameter(torch.from_numpy(arrays[key.replace("/", ".")]))
    inputs = probe_inputs(wrench, field, offset, FACE, arrays["modes"])
    inputs = np.concatenate([inputs, np.tile(FACE.inputs(), (4, 1))], axis=-1)
    scaled = (inputs - arrays["mean"]) / arrays["scale"]
    asked = np.tile(point_inputs(points, offset[-1] - offset[0]), (1, 4, 1, 1))
    with torch.no_grad():
        log_weight, mean, log_sd = net(
            torch.from_numpy(scaled[None].astype(np.float32)),
            torch.from_numpy(asked.astype(np.float32)),
        )
    np.testing.assert_allclose(found.weight, log_weight[0, -1].exp(), atol=1e-4)
    np.testing.assert_allclose(found.mean_mm, 10.0 * mean[0, -1], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(found.sd_mm, 10.0 * log_sd[0, -1].exp(), rtol=1e-3)


def test_what_is_known_after_two_probes_does_not_depend_on_a_third() -> None:
    rng, forward = np.random.default_rng(2), FusedForward(weights(2), SMALL)
    wrench, field = signals(rng, 3)
    offset = rng.normal(size=(3, 2))
    before = forward.known(wrench[:2], field[:2], offset[:2], FACE)
    after = forward.known(wrench, field, offset, FACE)
    np.testing.assert_allclose(after[:2], before, atol=1e-12)
    assert not np.allclose(after[2], before[1])


def test_a_mixture_exceeds_what_draws_from_it_exceed() -> None:
    rng, forward = np.random.default_rng(3), FusedForward(weights(3), SMALL)
    wrench, field = signals(rng, 1)
    known = forward.known(wrench, field, np.zeros((1, 2)), FACE)
    inset = forward.inset(known[:1], np.array([[1.0, 2.0]]), np.zeros(2))
    part = rng.choice(2, size=20_000, p=inset.weight[0])
    drawn = inset.mean_mm[0][part] + inset.sd_mm[0][part] * rng.normal(size=20_000)
    assert inset.expected_mm()[0] == pytest.approx(drawn.mean(), abs=0.3)
    middle = float(np.median(drawn))
    assert inset.exceeds(middle)[0] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(("across_x", "across_y"), MIRRORS[1:])
def test_with_its_mirror_images_a_grasp_is_answered_as_its_mirror_image(
    across_x: bool, across_y: bool
) -> None:
    rng, forward = np.random.default_rng(5), FusedForward(weights(5), SMALL)
    wrench, field = signals(rng, 2)
    offset, points = rng.normal(size=(2, 2)), 5.0 * rng.normal(size=(6, 2))
    signs = np.array([-1.0 if across_x else 1.0, -1.0 if across_y else 1.0])
    mirrored = mirror_signals(wrench, field, across_x=across_x, across_y=across_y)
    known = forward.known_by_mirror(wrench, field, offset, FACE)[:, -1]
    image = FACE.mirrored(across_x=across_x, across_y=across_y)
    other = forward.known_by_mirror(*mirrored, offset * signs, image)[:, -1]
    found = forward.inset(known, points, offset[-1] - offset[0])
    same = forward.inset(other, points * signs, (offset[-1] - offset[0]) * signs)
    np.testing.assert_allclose(same.exceeds(0.5), found.exceeds(0.5), atol=1e-6)
    alone = forward.inset(known[:1], points, offset[-1] - offset[0])
    assert not np.allclose(alone.exceeds(0.5), found.exceeds(0.5), atol=1e-3)
    np.testing.assert_allclose(found.weight.sum(axis=1), 1.0, atol=1e-6)


def test_an_ensemble_is_its_networks_together_and_trusts_the_least_confident() -> None:
    rng, members = np.random.default_rng(4), [weights(seed) for seed in (1, 2, 3)]
    shared = {name: members[0][name] for name in shared_arrays()}
    checkpoints = [
        FusedCheckpoint({**own, **shared}, FusedCard(
            hyper=SMALL, bench_sha256="b", data_sha256="d", seed=k, program_version="0",
            metrics={"held_out_loss": float(k)},
        ))
        for k, own in enumerate(members)
    ]  # fmt: skip
    joined = join_networks(checkpoints)
    assert joined.card.hyper.networks == 3
    assert joined.card.metrics == {"held_out_loss": 1.0}
    expected = expected_fused_arrays(joined.card.hyper)
    assert {name: array.shape for name, array in joined.arrays.items()} == expected
    wrench, field = signals(rng, 3)
    offset, points = rng.normal(size=(3, 2)), 5.0 * rng.normal(size=(6, 2))

    def insets(found: FusedCheckpoint) -> InsetDistribution:
        forward = FusedForward(found.arrays, found.card.hyper)
        known = forward.known_by_mirror(wrench, field, offset, FACE)[:, -1]
        return forward.inset(known, points, offset[-1] - offset[0])

    alone = [insets(one) for one in checkpoints]
    together = insets(joined)
    each = np.stack([one.exceeds(0.5) for one in alone])
    np.testing.assert_allclose(together.exceeds(0.5), each.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(together.surely_exceeds(0.5), each.min(axis=0), atol=1e-6)
    means = np.stack([one.expected_mm() for one in alone])
    np.testing.assert_allclose(together.expected_mm(), means.mean(axis=0), atol=1e-5)
    # Networks that differ are less certain together than on average.
    assert (together.variance_mm2() > np.mean([o.variance_mm2() for o in alone], axis=0)).all()
    other = replace(
        checkpoints[1], card=checkpoints[1].card.model_copy(update={"data_sha256": "x"})
    )
    with pytest.raises(InputError, match="different sizes or data"):
        join_networks([checkpoints[0], other])


@pytest.mark.parametrize(("across_x", "across_y"), [(True, False), (False, True), (True, True)])
def test_signals_mirror_as_a_mirrored_bench_feels_them(across_x: bool, across_y: bool) -> None:
    bench, catalogue = load_simulation(preset="bench-v1"), load_pieces()
    setting = OracleSetting(catalogue.top("pot"), catalogue.bottom("circle15"), bench)
    rng = np.random.default_rng(5)
    value = 0.7 * rng.standard_normal((3, oracle.COLUMNS))
    value[:, : oracle.TILT_X] *= 4.0
    other = value.copy()
    x, y = (-1.0 if across else 1.0 for across in (across_x, across_y))
    other[:, [oracle.SHIFT_X, oracle.GRASP_X]] *= x
    other[:, oracle.SHIFT_Y] *= y
    # A tilt turns about its axis, which keeps its sense when that very axis is mirrored.
    other[:, oracle.TILT_X] *= y
    other[:, oracle.TILT_Y] *= x
    other[:, oracle.YAW] *= x * y
    if across_y:
        gains = [oracle.GAIN_LEFT, oracle.GAIN_RIGHT]
        other[:, gains] = other[:, gains[::-1]]
    one, two = (
        predict_press(
            setting,
            HypothesisEnsemble(v, GraspHistory.fresh(3)),
            (0.0, 0.0),
            np.random.default_rng(8),
        )
        for v in (value, other)
    )
    assert one.usable.all()
    wrench, field = mirror_signals(
        one.observation[..., 252:], one.observation[..., :252], across_x=across_x, across_y=across_y
    )
    np.testing.assert_allclose(wrench, two.observation[..., 252:], atol=2e-3)
    # The two cameras grab at instants of their own, up to a frame apart.
    np.testing.assert_allclose(field, two.observation[..., :252], rtol=0.03, atol=0.02)


def test_a_face_mirrors_like_its_points() -> None:
    points = face_points(rectangle(20.0, 12.0)) @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    com = np.array([1.0, 0.5])
    whole = GraspedFace.of(points, com, np.array(30.0))
    for across_x, across_y in ((True, False), (False, True), (True, True)):
        signs = np.where([across_x, across_y], -1.0, 1.0)
        expected = GraspedFace.of(points * signs, com * signs, np.array(30.0))
        found = whole.mirrored(across_x=across_x, across_y=across_y)
        np.testing.assert_allclose(found.inputs(), expected.inputs(), atol=1e-9)


def test_where_a_growing_force_acts() -> None:
    # 8 N down at (3, -2) mm of the face, with a lateral part, at a sensor 150 mm above it.
    fx, fy, fz = 0.8, -0.4, 8.0
    growth = np.array([fx, fy, fz, 1e-3 * (-2 * fz + 150 * fy), 1e-3 * (-3 * fz - 150 * fx), 0.0])
    np.testing.assert_allclose(acting_point_mm(growth, np.array(150.0)), [3.0, -2.0], atol=1e-9)
    np.testing.assert_allclose(acting_point_mm(0.05 * growth, np.array(150.0)), 0.0)


def test_typical_fields_hold_all_that_a_pad_can_do() -> None:
    rng, gel = np.random.default_rng(4), build_gel((0.058, 0.058))
    moves = rng.normal(size=(60, 8, 2, 4))
    fields = np.einsum("ntfm,fmk->ntfk", moves, gel.map).reshape(60, 8, 2, 63, 2)
    fields = fields + rng.normal(size=(60, 1, 2, 1, 2))  # a shift of the reference
    flat = fields.swapaxes(-1, -2).reshape(60, 8, 252).astype(np.float32)
    modes = field_components(flat)
    again = field_components(flat[::2])
    for finger in range(2):
        # The span is that of all fields, whichever are looked at.
        lost = again[finger] - again[finger] @ modes[finger].T @ modes[finger]
        assert np.abs(lost).max() < 1e-3


def made_up(count: int, seed: int) -> Arrays:
    """Sequences of two probes whose force along x and y is the displacement itself."""
    rng = np.random.default_rng(seed)
    true = rng.uniform(-8.0, 8.0, (count, 2, 2)).astype(np.float32)
    wrench = 0.1 * rng.normal(size=(count, 2, 8, 6)).astype(np.float32)
    wrench[..., :2] += 0.2 * true[:, :, None]
    corners = circle(20.0).polygon(32).astype(np.float32)
    return {
        "wrench": wrench,
        "field": rng.normal(size=(count, 2, 8, 252)).astype(np.float32),
        "offset_mm": np.zeros((count, 2, 2), np.float32),
        "true_mm": true,
        "count": np.full(count, 2),
        "support_mm": np.tile(corners, (count, 1, 1)),
        "reach_mm": np.full((count, 16), 7.0, np.float32),
        "com_mm": np.zeros((count, 2), np.float32),
        "grip_height_mm": np.full(count, 30.0, np.float32),
    }


def test_the_true_inset_is_that_of_the_outline() -> None:
    arrays = made_up(2, 1)
    outline = rectangle(14.0, 10.0)
    padded = np.concatenate([outline.polygon(), np.repeat(outline.polygon()[-1:], 28, axis=0)])
    arrays["support_mm"] = np.tile(padded.astype(np.float32), (2, 1, 1))
    modes = field_components(arrays["field"])
    data: ProbeSequences = prepare_sequences([arrays], modes, mirror=True)
    points = torch.tensor([[1.0, 2.0], [-3.0, 0.5]]).expand(8, 2, 2, 2)
    found = data.inset_mm(torch.arange(8), points + data.true_mm[:, :, None]).numpy()
    expected = inset_mm(outline, (points + data.true_mm[:, :, None]).numpy().astype(np.float64))
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_margins_replace_the_outline_and_are_mirrored_with_it() -> None:
    arrays = made_up(2, 1)
    axis = np.linspace(-36.0, 36.0, 25)
    nodes = 0.5 * axis[None, :] - 0.25 * axis[:, None]
    arrays["margin_mm"] = np.stack([nodes, 2.0 * nodes]).astype(np.float16)
    data: ProbeSequences = prepare_sequences(
        [arrays], field_components(arrays["field"]), mirror=True
    )
    points = torch.tensor([[1.0, 2.0], [-3.0, 0.5]]).expand(8, 2, 2, 2)
    found = data.inset_mm(torch.arange(8), points + data.true_mm[:, :, None]).numpy()
    at = (points + data.true_mm[:, :, None]).numpy()
    signs = np.repeat([[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]], 2, axis=0)
    at = at * signs[:, None, None]
    expected = (0.5 * at[..., 0] - 0.25 * at[..., 1]) * np.tile([1.0, 2.0], 4)[:, None, None]
    np.testing.assert_allclose(found, expected, atol=2e-2)


def test_a_training_learns_and_is_the_same_again() -> None:
    settings = FusedTraining(100, 32, learning_rate=1e-2, seed=3, shape=SMALL)
    train, held_out = made_up(96, 1), made_up(32, 2)
    trainer = FusedTrainer([train], [held_out], settings)
    before = trainer.held_out_loss()
    losses = list(trainer.steps())
    assert np.mean(losses[-10:]) < 0.5 * losses[0]
    assert trainer.held_out_loss() < before - 0.7
    short = FusedTraining(steps=3, batch=48, seed=3, shape=SMALL)
    twice = [FusedTrainer([train], [held_out], short) for _ in range(2)]
    for one in twice:
        list(one.steps())
    first, second = (one.arrays() for one in twice)
    assert all(np.array_equal(first[name], second[name]) for name in first)


def test_a_network_of_the_wrench_alone_does_not_read_the_markers() -> None:
    train, held_out = made_up(48, 1), made_up(16, 2)
    rng, wrench = np.random.default_rng(5), signals(np.random.default_rng(4), 2)[0]
    fields = rng.normal(size=(2, 2, 8, 252)).astype(np.float32)
    for alone in (True, False):
        settings = FusedTraining(3, 24, seed=3, shape=SMALL, wrench_alone=alone)
        trainer = FusedTrainer([train], [held_out], settings)
        list(trainer.steps())
        again = replace(settings, wrench_alone=False, start=trainer.arrays())
        for arrays in (trainer.arrays(), FusedTrainer([train], [held_out], again).arrays()):
            forward = FusedForward(arrays, SMALL)
            known = [forward.known(wrench, field, np.zeros((2, 2)), FACE) for field in fields]
            assert np.allclose(*known, rtol=0.0, atol=1e-6) is alone
            share = forward.distances(wrench, fields[0], np.zeros((2, 2)), FACE)[1]
            assert (share == 0.0) is alone


def test_probes_in_another_order_are_those_of_a_trial_in_that_order() -> None:
    rng, held_out = np.random.default_rng(6), made_up(8, 2)
    train = {**made_up(16, 1), "count": rng.integers(1, 3, 16)}
    train["offset_mm"] = rng.uniform(-5.0, 5.0, (16, 2, 2)).astype(np.float32)
    back = np.where(train["count"][:, None] == 2, [[1, 0]], [[0, 1]])
    turned = {
        name: np.take_along_axis(a, back.reshape(16, 2, *(a.ndim - 2) * [1]), axis=1)
        if name in ("wrench", "field", "offset_mm", "true_mm")
        else a
        for name, a in train.items()
    }
    settings = FusedTraining(1, 16, seed=3, shape=SMALL, shuffled=1.0)
    trainer = FusedTrainer([train], [held_out], settings)
    other = FusedTrainer([turned], [held_out], replace(settings, start=trainer.arrays()))
    rows, images = torch.arange(64), torch.tensor(np.tile(back, (4, 1)))
    pressed = torch.arange(2).expand(64, -1)
    loss, expected = (
        one._loss(one._train, rows, order, torch.Generator().manual_seed(1))
        for one, order in ((trainer, images), (other, pressed))
    )
    torch.testing.assert_close(loss, expected)
    order = trainer._order(rows, 2)
    there = trainer._train.there
    assert torch.equal(order.sort(dim=1).values, pressed)
    assert torch.equal(there[rows[:, None], order], there)  # the missing probes stay last
    assert 0 < int((order != pressed).any(dim=1).sum()) < 64


def test_a_kick_blurs_the_target() -> None:
    train, held_out = made_up(96, 1), made_up(32, 2)
    settings = FusedTraining(3, 48, seed=3, shape=SMALL, kick_mm=0.5)
    trainer = FusedTrainer([train], [held_out], settings)
    plain = FusedTrainer([train], [held_out], replace(settings, kick_mm=0.0))
    assert trainer.held_out_loss() != plain.held_out_loss()
    assert torch.equal(trainer.mean, plain.mean)


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    card = FusedCard(hyper=SMALL, bench_sha256="b", data_sha256="d", seed=1, program_version="0")
    path = tmp_path / "fused.safetensors"
    save_checkpoint(path, weights(1), card)
    return path


def test_weights_arrive_as_they_left(kept: Path) -> None:
    found = load_fused(kept)
    assert found.card.hyper == SMALL
    assert all(np.array_equal(found.arrays[name], a) for name, a in weights(1).items())


@pytest.mark.parametrize("what", ["damaged", "pickle", "other sizes", "other ticks", "too large"])
def test_a_bad_file_is_refused_by_name(kept: Path, what: str) -> None:
    content, card = bytearray(kept.read_bytes()), json.loads(kept.with_suffix(".json").read_text())
    if what == "damaged":
        content[-1] ^= 1
    elif what == "pickle":
        content[:2] = b"\x80\x04"
    elif what == "other sizes":
        card["hyper"]["inner"] = 25
    elif what == "other ticks":
        card["ticks"] = [0, 1, 2, 3, 4, 5, 6, 7]
    else:
        content += bytes(10_000_000)
    kept.write_bytes(bytes(content))
    kept.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(InputError) as refused:
        load_fused(kept)
    assert kept.name in str(refused.value)
    assert len(TICKS) == 8


WRITER = [sys.executable, "-m", "tests.backend.learning.fused.fused_writer"]
ROOT = Path(__file__).parents[4]
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of POSIX")


@POSIX
@pytest.mark.parametrize("writes", [1, 2])
def test_killed_at_any_time_it_is_whole_or_refused(tmp_path: Path, writes: int) -> None:
    with subprocess.Popen(
        [*WRITER, str(tmp_path), "kill"], stdout=subprocess.PIPE, cwd=ROOT
    ) as child:
        assert child.stdout is not None
        for _ in range(writes):
            assert child.stdout.readline()
        child.kill()
    refused = ""
    try:
        found = load_fused(tmp_path / NAME)
    except InputError as error:
        refused = str(error)
    else:
        values = {float(v) for array in found.arrays.values() for v in np.unique(array)}
        assert values == {float(found.card.seed)}
    assert not refused or NAME in refused
    write(tmp_path, 1)
    assert load_fused(tmp_path / NAME).card.seed == 1


def test_weights_of_one_and_the_card_of_another_are_refused(tmp_path: Path) -> None:
    """As a kill between the two files leaves them."""
    write(tmp_path, 1)
    weights = (tmp_path / NAME).read_bytes()
    write(tmp_path, 2)
    (tmp_path / NAME).write_bytes(weights)
    with pytest.raises(InputError, match=r"not those of their card"):
        load_fused(tmp_path / NAME)


@POSIX
def test_a_disk_that_takes_no_more_leaves_the_former_network(tmp_path: Path) -> None:
    write(tmp_path, 1)
    refused = subprocess.run(
        [*WRITER, str(tmp_path), "full"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert refused.returncode != 0
    assert "File too large" in refused.stderr
    assert load_fused(tmp_path / NAME).card.seed == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fused.json", NAME]
