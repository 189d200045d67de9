"""Adam compared with its formula; modules that it must not load."""

from __future__ import annotations

import itertools
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from touchdown.backend.cli.command_line import main
from touchdown.backend.config.method import TrainingSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.episodes.training_rows import TrainingRows, split_rows
from touchdown.backend.learning import (
    NetworkShape,
    Trainer,
    device_name,
    fingerprint,
    modality_columns,
    predict,
    select_device,
    use_one_thread,
)
from touchdown.backend.learning.inference import Modality, channel_groups, fit_normaliser_in_parts
from touchdown.backend.learning.training import (
    NEWTON_SCHULZ_STEPS,
    Adam,
    MuonAdam,
    computes_bfloat16,
    load_training_state,
    new_model,
    predict_logits,
    save_training_state,
)

RATE = 0.01


def by_formula(weight: np.ndarray, gradients: list[np.ndarray]) -> np.ndarray:
    """Algorithm 1 of arXiv 1412.6980 in float64, with its own constants."""
    mean, square = np.zeros_like(weight), np.zeros_like(weight)
    for t, gradient in enumerate(gradients, 1):
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.999 * square + 0.001 * gradient**2
        step = (mean / (1 - 0.9**t)) / (np.sqrt(square / (1 - 0.999**t)) + 1e-8)
        weight = weight - RATE * step
    return weight


def test_steps_follow_the_formula_and_go_on_from_kept_moments() -> None:
    rng = np.random.default_rng(2)
    start, gradients = rng.normal(size=(3, 4)), [rng.normal(size=(3, 4)) for _ in range(6)]
    parameter = torch.nn.Parameter(torch.tensor(start, dtype=torch.float32))
    optimiser = Adam([parameter], RATE)
    for number, gradient in enumerate(gradients):
        if number == 3:
            again = Adam([parameter], RATE)
            again.take_up(optimiser.moments)
            optimiser = again
        parameter.grad = torch.tensor(gradient, dtype=torch.float32)
        optimiser.step()
        optimiser.zero_grad()
        assert parameter.grad is None
    reached = parameter.detach().numpy()
    np.testing.assert_allclose(reached, by_formula(start, gradients), rtol=0, atol=2e-6)


def test_muon_follows_that_of_torch_and_goes_on_from_kept_moments() -> None:
    rng = np.random.default_rng(3)
    for shape in ((6, 4), (4, 6)):
        start, gradients = rng.normal(size=shape), [rng.normal(size=shape) for _ in range(6)]
        ours, theirs = (torch.nn.Parameter(torch.tensor(start)) for _ in range(2))
        own = MuonAdam([ours], [], RATE, torch.bfloat16)
        reference = torch.optim.Muon(
            [theirs], RATE, 0.0, ns_steps=NEWTON_SCHULZ_STEPS, adjust_lr_fn="match_rms_adamw"
        )
        for number, gradient in enumerate(gradients):
            if number == 3:
                again = MuonAdam([ours], [], RATE, torch.bfloat16)
                again.take_up(own.moments)
                own = again
            ours.grad, theirs.grad = torch.tensor(gradient), torch.tensor(gradient)
            own.step()
            reference.step()
            own.zero_grad()
            assert ours.grad is None
        moved = np.abs(theirs.detach().numpy() - start).max()
        np.testing.assert_allclose(ours.detach(), theirs.detach(), rtol=0, atol=0.01 * moved)


def test_a_batch_in_parts_gives_the_gradient_of_the_whole_batch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = SMALL.model_copy(update={"batch": 100})
    weights, losses = [], []
    for at_once in (1000, 16):
        monkeypatch.setattr(f"{Trainer.__module__}.EPISODES_PER_GRADIENT", at_once)
        trainer = Trainer(rows(60), settings)
        losses.append(next(trainer.epochs()).train_loss)
        weights.append(torch.cat([p.detach().flatten() for p in trainer.model.parameters()]))
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)
    torch.testing.assert_close(weights[0], weights[1], rtol=0, atol=0.02 * RATE)


def test_muon_moves_the_matrices_of_the_lstm_layers_only() -> None:
    muon = SMALL.model_copy(update={"optimiser": "Muon"})
    trainer = Trainer(rows(24), muon)
    by_muon = [kept["momentum"].shape for kept in trainer.optimiser.moments if "momentum" in kept]
    assert by_muon == [p.shape for p in trainer.model.lstm.parameters() if p.dim() == 2]
    before = {name: p.detach().clone() for name, p in trainer.model.named_parameters()}
    next(trainer.epochs())
    assert all(not p.equal(before[name]) for name, p in trainer.model.named_parameters())


def test_a_training_does_not_load_the_compiler_of_torch() -> None:
    """Loading it takes as long as loading torch, at the start of every training."""
    before = set(sys.modules)
    use_one_thread()
    assert torch.are_deterministic_algorithms_enabled()
    assert not torch.is_deterministic_algorithms_warn_only_enabled()
    parameter = torch.nn.Parameter(torch.ones(2))
    optimiser = Adam([parameter], RATE)
    parameter.sum().backward()
    optimiser.step()
    assert "torch._dynamo" not in set(sys.modules) - before


def rows(count: int, per_grip: int = 2, mountings: int = 1, points: int = 9) -> TrainingRows:
    """Episodes whose torques tell which half of the face is in contact."""
    rng = np.random.default_rng(5)
    observation = rng.normal(size=(count, 20, 258)).astype(np.float32)
    side = rng.choice([-1.0, 1.0], count)
    observation[:, :, 256] += 8 * side[:, None].astype(np.float32)
    column = np.arange(points) % 3 - 1
    patch = column[None, :] * side[:, None] >= 0
    return TrainingRows(
        "pot", "ab" * 32, observation, np.stack([side, 0 * side], 1), patch,
        ("circle15",) * count,
        tuple(f"g{i // per_grip}" for i in range(count)),
        tuple(f"m{i // per_grip * per_grip * mountings // count}" for i in range(count)),
        tuple({"episode": f"e{i}"} for i in range(count)),
    )  # fmt: skip


SMALL = TrainingSettings(
    hidden=16, epochs=4, batch=4, validation_share=0.25, seed=3, divide_series=True
)


@pytest.mark.parametrize(
    ("inputs", "points", "layer_1", "head"),
    [(258, 505, 528_384, 129_785), (252, 177, 522_240, 45_489), (6, 349, 270_336, 89_693)],
)
def test_parameter_counts_of_the_method(inputs: int, points: int, layer_1: int, head: int) -> None:
    model = new_model(NetworkShape(inputs, 256, 2, points), 0)
    count = {name: p.numel() for name, p in model.named_parameters()}
    assert sum(n for name, n in count.items() if name.endswith("_l0")) == layer_1
    assert sum(n for name, n in count.items() if name.endswith("_l1")) == 526_336
    assert sum(n for name, n in count.items() if name.startswith("head")) == head


def test_modalities_cover_the_vector() -> None:
    sizes = {m: modality_columns(m).stop - modality_columns(m).start for m in get_args(Modality)}
    assert sizes == {"FT": 6, "Tac": 252, "FT+Tac": 258}
    groups = channel_groups()
    assert np.bincount(groups).tolist() == [63, 63, 63, 63, 1, 1, 1, 1, 1, 1]


@pytest.mark.parametrize("modality", get_args(Modality))
def test_standardised_channels_have_zero_mean_and_unit_scale_per_group(modality: str) -> None:
    rng = np.random.default_rng(1)
    spread = np.geomspace(1e-3, 1e3, 258)
    x = (rng.normal(size=(50, 20, 258)) * spread + spread).astype(np.float32)
    part = modality_columns(modality)  # type: ignore[arg-type]
    fit = fit_normaliser_in_parts([x], modality)  # type: ignore[arg-type]
    z = ((x[:, :, part] - fit.mean) / fit.scale).reshape(-1, part.stop - part.start)
    assert np.abs(z.mean(axis=0)).max() < 1e-3
    groups = channel_groups()[part]
    for group in np.unique(groups):
        assert np.mean(z[:, groups == group] ** 2) == pytest.approx(1.0, rel=1e-3)


def test_fitting_in_parts_equals_fitting_at_once() -> None:
    x = np.random.default_rng(8).normal(3.0, 2.0, (50, 20, 258)).astype(np.float32)
    x[30:] *= 5
    whole = fit_normaliser_in_parts([x], "FT+Tac")
    parts = fit_normaliser_in_parts([x[:1], x[1:33], x[33:]], "FT+Tac")
    assert np.allclose(parts.mean, whole.mean, rtol=1e-6)
    assert np.allclose(parts.scale, whole.scale, rtol=1e-6)
    assert np.allclose(whole.mean, x.reshape(-1, 258).mean(0), rtol=1e-4)


def test_a_channel_that_never_changes_is_left_alone() -> None:
    fit = fit_normaliser_in_parts([np.zeros((3, 20, 258), np.float32)], "FT+Tac")
    assert (fit.scale == 1).all()


def test_the_order_of_time_matters() -> None:
    model = new_model(NetworkShape(6, 16, 2, 4), 1)
    x = torch.randn(1, 20, 6, generator=torch.Generator().manual_seed(1))
    assert not torch.allclose(model(x), model(x.flip(1)))
    assert model(x).shape == (1, 4)


@pytest.mark.parametrize(
    ("mountings", "divide_series", "kind"),
    [(1, True, "grip"), (9, True, "grip"), (9, False, "series"), (40, False, "mounting")],
)
def test_no_grip_series_or_mounting_is_on_both_sides(
    mountings: int, divide_series: bool, kind: str
) -> None:
    data = rows(400, per_grip=5, mountings=mountings)
    split = split_rows(data, 0.12, seed=2, divide_series=divide_series)
    assert split.kept_together == kind
    assert sorted([*split.train, *split.held_out]) == list(range(400))
    assert 0.05 <= len(split.held_out) / 400 <= 0.2
    ids = data.grip_id if kind == "grip" else data.mounting_id
    assert not {ids[i] for i in split.train} & {ids[i] for i in split.held_out}


def test_one_grip_or_one_series_alone_cannot_be_split() -> None:
    with pytest.raises(InputError, match="one grip"):
        split_rows(rows(8, per_grip=8), 0.25, 0, divide_series=True)
    with pytest.raises(InputError, match="one series only of pot on circle15"):
        split_rows(rows(8, per_grip=2), 0.25, 0)


def test_eight_episodes_are_learnt_by_heart() -> None:
    data = rows(8, per_grip=1)
    settings = TrainingSettings(
        hidden=32, epochs=60, patience=60, learning_rate=0.01, batch=7, schedule="constant",
        divide_series=True,
    )  # fmt: skip
    trainer = Trainer(data, settings)
    reports = list(trainer.epochs())
    assert reports[0].train_loss == pytest.approx(math.log(2), abs=0.05)
    assert reports[-1].train_loss < 0.02
    known = trainer.split.train
    predicted = predict(trainer.model, data.observation[known], modality_columns("FT+Tac")) > 0.5
    assert np.array_equal(predicted, data.patch[known])
    assert [r.epoch for r in reports] == list(range(1, 61))


def test_coarse_products_train_float32_weights_to_nearly_the_same_loss() -> None:
    data = rows(24)
    if not computes_bfloat16(torch.device("cpu")):
        with pytest.raises(InputError, match="This processor cannot multiply in bfloat16"):
            Trainer(data, SMALL.model_copy(update={"precision": "bfloat16"}))
        return
    exact, coarse = (
        Trainer(data, SMALL.model_copy(update={"precision": name}))
        for name in ("float32", "bfloat16")
    )
    losses = [[report.validation_loss for report in t.epochs()] for t in (exact, coarse)]
    assert losses[0] != losses[1]
    assert losses[1] == pytest.approx(losses[0], rel=0.03)
    assert {w.dtype for w in coarse.model.state_dict().values()} == {torch.float32}


@pytest.mark.promise("W14")
@pytest.mark.parametrize("optimiser", ["Adam", "Muon"])
def test_resume_equals_uninterrupted_bit_for_bit(tmp_path: Path, optimiser: str) -> None:
    data, small = rows(24), SMALL.model_copy(update={"optimiser": optimiser})
    name = fingerprint(data)
    whole = Trainer(data, small)
    expected = list(whole.epochs())

    first = Trainer(data, small)
    got = list(itertools.islice(first.epochs(), 2))
    save_training_state(tmp_path / "a.resume.safetensors", first, name)
    second = Trainer(data, small)
    load_training_state(tmp_path / "a.resume.safetensors", second, name)
    got += list(second.epochs())

    assert got == expected
    for a, b in ((whole.model, second.model), (whole.best_model(), second.best_model())):
        states = zip(a.state_dict().items(), b.state_dict().items(), strict=True)
        assert all(ka == kb and torch.equal(va, vb) for (ka, va), (kb, vb) in states)


def test_a_cancelled_epoch_leaves_no_report_and_resume_repeats_it(tmp_path: Path) -> None:
    data = rows(24)
    calls = itertools.count()
    trainer = Trainer(data, SMALL)
    # 18 training episodes in batches of 4 are 5 calls an epoch: cancelled within the third
    reports = list(trainer.epochs(lambda: next(calls) >= 12))
    assert [r.epoch for r in reports] == [1, 2]
    assert reports == list(itertools.islice(Trainer(data, SMALL).epochs(), 2))


def test_resume_refuses_other_data_other_settings_and_damage(tmp_path: Path) -> None:
    data, path = rows(24), tmp_path / "a.resume.safetensors"
    with pytest.raises(InputError, match="no usable"):
        load_training_state(path, Trainer(data, SMALL), "x")
    trainer = Trainer(data, SMALL)
    next(trainer.epochs())
    save_training_state(path, trainer, "x")
    with pytest.raises(InputError, match="other data"):
        load_training_state(path, Trainer(data, SMALL), "y")
    other = SMALL.model_copy(update={"learning_rate": 0.1})
    with pytest.raises(InputError, match="other data or settings"):
        load_training_state(path, Trainer(data, other), "x")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="no usable"):
        load_training_state(path, Trainer(data, SMALL), "x")


def test_fingerprint_sees_every_target() -> None:
    data = rows(8)
    patch = data.patch.copy()
    patch[7, 8] = ~patch[7, 8]
    assert fingerprint(data) != fingerprint(replace(data, patch=patch))


def test_training_stops_when_validation_gets_no_better() -> None:
    noise = rows(24)
    unlearnable = replace(noise, patch=noise.patch[np.random.default_rng(0).permutation(24)])
    settings = SMALL.model_copy(update={"epochs": 200, "patience": 3, "learning_rate": 0.02})
    reports = list(Trainer(unlearnable, settings).epochs())
    best = min(reports, key=lambda r: r.validation_loss)
    assert len(reports) == best.epoch + 3 < 200
    assert reports[-1].best_epoch == best.epoch


def test_the_rate_falls_as_a_cosine_and_so_across_a_resume(tmp_path: Path) -> None:
    data = rows(24)
    trainer = Trainer(data, SMALL)
    rates = []
    for report in trainer.epochs():
        rates.append(trainer.optimiser.rate)
        if report.epoch == 2:
            save_training_state(tmp_path / "a.resume.safetensors", trainer, "x")
    # 1e-3 (1 + cos(pi k / 4)) / 2 for k = 0, 1, 2, 3
    assert rates == pytest.approx([1e-3, 0.853553e-3, 0.5e-3, 0.146447e-3], rel=1e-5)
    again = Trainer(data, SMALL)
    load_training_state(tmp_path / "a.resume.safetensors", again, "x")
    next(again.epochs())
    assert again.optimiser.rate == rates[2]


GPU = torch.cuda.is_available()


def test_a_graphics_processor_is_taken_where_torch_finds_one(monkeypatch):
    for found, asked, chosen in (
        (True, "auto", "cuda"), (False, "auto", "cpu"), (True, "cpu", "cpu"),
        (False, "cpu", "cpu"), (True, "cuda", "cuda"),
    ):  # fmt: skip
        monkeypatch.setattr(torch.cuda, "is_available", lambda found=found: found)
        assert select_device(asked).type == chosen
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no graphics processor"):
        select_device("cuda")
    assert device_name(select_device("auto")) == "cpu"


@pytest.mark.skipif(GPU, reason="there is one")
def test_a_training_on_what_is_not_there_is_refused_in_one_sentence(tmp_path, write_data, capsys):
    data, out = write_data(tmp_path / "data", 36), tmp_path / "pot.safetensors"
    code = main(["train", str(data), "--device", "cuda", "--out", str(out)])
    said = capsys.readouterr().err
    assert code == 2
    assert "graphics processor" in said
    assert "--device cpu" in said
    assert not out.exists()


@pytest.mark.skipif(not GPU, reason="needs a graphics processor")
def test_a_graphics_processor_trains_what_a_processor_trains():
    data = rows(24)
    settings = SMALL.model_copy(update={"epochs": 3})
    here, there = Trainer(data, settings), Trainer(data, settings, select_device("cuda"))
    for ours, theirs in zip(here.epochs(), there.epochs(), strict=True):
        assert theirs.validation_loss == pytest.approx(ours.validation_loss, rel=1e-3)
    assert np.allclose(here.predict_held_out(), there.predict_held_out(), atol=1e-2)
    assert all(tensor.device.type == "cpu" for tensor in there.best_state.values())
    assert computes_bfloat16(there.device) in (True, False)


def unlike_held_out() -> TrainingRows:
    """Episodes whose held-out side has other signals, and contact everywhere."""
    data = rows(24)
    held_out = split_rows(data, SMALL.validation_share, SMALL.seed, divide_series=True).held_out
    observation, patch = data.observation.copy(), data.patch.copy()
    observation[held_out] = 5.0 * observation[held_out] + 30.0
    patch[held_out] = True
    return replace(data, observation=observation, patch=patch)


def test_base_rate_and_normaliser_are_those_of_the_training_side() -> None:
    data = unlike_held_out()
    trainer = Trainer(data, SMALL)
    train = trainer.split.train
    assert 0 < len(train) < len(data)
    assert trainer.base_rate == pytest.approx(6 / 9)
    expected = fit_normaliser_in_parts([data.observation[train]], SMALL.modality)
    np.testing.assert_allclose(trainer.model.mean.numpy(), expected.mean, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(trainer.model.scale.numpy(), expected.scale, rtol=1e-5)


def test_the_weights_that_are_kept_are_those_of_the_best_epoch() -> None:
    """Nothing can be learnt here: the longer it goes on, the worse it does on what it never saw."""
    data = rows(24)
    order = np.random.default_rng(0).permutation(24)
    settings = SMALL.model_copy(update={"epochs": 12, "patience": 12, "learning_rate": 0.02})
    trainer = Trainer(replace(data, patch=data.patch[order]), settings)
    losses = [report.validation_loss for report in trainer.epochs()]
    assert losses[-1] > min(losses) + 0.05
    held_out = trainer.split.held_out
    truth = torch.from_numpy(data.patch[order][held_out].astype(np.float32))
    seen = torch.from_numpy(data.observation[held_out])
    loss = float(
        binary_cross_entropy_with_logits(predict_logits(trainer.best_model(), seen), truth)
    )
    assert loss == pytest.approx(min(losses), rel=1e-5)
    p = torch.from_numpy(trainer.predict_held_out())
    assert float(binary_cross_entropy_with_logits(torch.logit(p), truth)) == pytest.approx(
        min(losses), rel=1e-4
    )
