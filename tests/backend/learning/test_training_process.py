"""Estimator compared with the network; NaN and foreign models are refused."""

import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import binomtest, bootstrap
from shapely import MultiPoint, Point

from touchdown.backend.bench.assembly import shipped_model
from touchdown.backend.cli.command_line import main
from touchdown.backend.config.method import TrainingSettings
from touchdown.backend.core import Episode, EpisodeQuality, InputError
from touchdown.backend.episodes import PackedEpisode, patch_hex, write_packs
from touchdown.backend.geometry import Piece, face_points, load_pieces
from touchdown.backend.learning import (
    Checkpoint,
    ModelCard,
    NetworkShape,
    PatchForward,
    TrainingEpoch,
    TrainingFinished,
    TrainingLoaded,
    card_path,
    evaluate,
    fitting,
    load_card,
    load_checkpoint,
    load_network,
    modality_columns,
    rate_interval,
    save_checkpoint,
    stable_flags,
    train_model,
    training_runs,
)
from touchdown.backend.learning.fitting import fit_model
from touchdown.backend.learning.inference import ARCH, Modality, Normaliser
from touchdown.backend.learning.metrics import (
    clustered_interval,
    hull_margin_mm,
    iou,
    point_accuracy,
    score,
    wilson_interval,
)
from touchdown.backend.learning.training import PatchNet, computes_bfloat16, new_model, resume_path
from touchdown.backend.learning.training_process import (
    TrainingJob,
    TrainingProcess,
    default_threads,
)
from touchdown.backend.learning.training_runs import make_training_job
from touchdown.backend.placement.estimator import Estimator


def episode(observation: np.ndarray, piece: str = "pot") -> Episode:
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 1.0, 0.0)
    return Episode("e1", piece, observation.astype(np.float32), np.zeros(2), 0.3, quality)


def write_model(path: Path, of: Piece, modality: Modality = "FT+Tac", **card: object) -> Path:
    inputs = modality_columns(modality).stop - modality_columns(modality).start
    points = len(face_points(of.face))
    model = new_model(NetworkShape(inputs, 256, 2, points), 9)
    fields = {
        "arch": ARCH, "modality": modality, "piece": of.name, "geometry": of.sha256,
        "hyper": NetworkShape(inputs, 256, 2, points), "base_rate": 0.3,
        "seed": 9, "program_version": "0", "weights_sha256": "",
    }  # fmt: skip
    save_checkpoint(path, model.arrays(), ModelCard.model_validate(fields | card))
    return path


@pytest.mark.parametrize("modality", ["FT", "Tac", "FT+Tac"])
def test_equals_the_network_on_the_channels_of_its_modality(
    tmp_path: Path, pot: Piece, modality: Modality
) -> None:
    estimator = Estimator.load(write_model(tmp_path / "m.safetensors", pot, modality), pot)
    observation = np.random.default_rng(1).normal(size=(20, 258)).astype(np.float32)
    patch = estimator.estimate(episode(observation))
    inputs = modality_columns(modality).stop - modality_columns(modality).start
    model = new_model(NetworkShape(inputs, 256, 2, 177), 9).eval()
    x = {"FT": observation[:, 252:], "Tac": observation[:, :252]}.get(modality, observation)
    with torch.no_grad():
        expected = torch.sigmoid(model(torch.from_numpy(x.copy())[None]))[0].numpy()
    assert np.allclose(patch.probability, expected, atol=1e-6)
    assert np.array_equal(patch.points_mm, face_points(pot.face))
    assert estimator.estimate(episode(observation)).probability.tolist() == (
        patch.probability.tolist()
    )


def test_preparing_never_changes_an_estimate(tmp_path: Path, pot: Piece) -> None:
    path = write_model(tmp_path / "m.safetensors", pot)
    probes = np.random.default_rng(4).normal(size=(3, 20, 258)).astype(np.float32)
    plain = [Estimator.load(path, pot).estimate(episode(rows)).probability for rows in probes]
    estimator = Estimator.load(path, pot)
    estimator.prepare(probes[0][:19])
    for rows, expected in zip(probes, plain, strict=True):
        # Bit for bit, prepared for this probe, for another, or with one value corrected since.
        assert np.array_equal(estimator.estimate(episode(rows)).probability, expected)
        estimator.prepare(rows[:19])
        assert np.array_equal(estimator.estimate(episode(rows)).probability, expected)
    estimator.prepare(np.full((19, 258), np.nan, np.float32))
    assert np.array_equal(estimator.estimate(episode(probes[2])).probability, plain[2])
    corrected = probes[2].copy()
    corrected[18, 257] += 1.0
    changed = estimator.estimate(episode(corrected)).probability
    assert not np.array_equal(changed, plain[2])
    assert np.array_equal(
        changed, Estimator.load(path, pot).estimate(episode(corrected)).probability
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("channel", [0, 251, 257])
def test_a_value_that_is_not_finite_is_refused(
    tmp_path: Path, pot: Piece, value: float, channel: int
) -> None:
    estimator = Estimator.load(write_model(tmp_path / "m.safetensors", pot), pot)
    observation = np.zeros((20, 258))
    observation[11, channel] = value
    with pytest.raises(InputError, match=f"not finite .channel {channel} first"):
        estimator.estimate(episode(observation))


def test_episodes_that_do_not_belong_are_refused(tmp_path: Path, pot: Piece) -> None:
    estimator = Estimator.load(write_model(tmp_path / "m.safetensors", pot), pot)
    with pytest.raises(InputError, match="'barrel'"):
        estimator.estimate(episode(np.zeros((20, 258)), "barrel"))
    with pytest.raises(InputError, match="shape"):
        estimator.estimate(episode(np.zeros((19, 258))))


def test_models_that_do_not_belong_are_refused_by_name(tmp_path: Path, pot: Piece) -> None:
    barrel = load_pieces().piece("barrel")
    path = tmp_path / "m.safetensors"
    other = hashlib.sha256(b"other").hexdigest()
    cases = [
        (barrel, {}, "of 'barrel', not of 'pot'"),
        (pot, {"geometry": other}, "another version"),
        (barrel, {"piece": "pot"}, "349 face points, 'pot' has 177"),
    ]
    for piece, card, words in cases:
        write_model(path, piece, **card)
        with pytest.raises(InputError, match=words) as error:
            Estimator.load(path, pot)
        assert error.value.where == str(path)


def test_divergence_is_named_and_leaves_no_model(
    tmp_path: Path, write_data: Callable[[Path], Path]
) -> None:
    out = tmp_path / "pot.safetensors"
    job = TrainingJob(
        data=write_data(tmp_path / "data"),
        piece="pot",
        out=out,
        settings=TrainingSettings(hidden=4, epochs=9, patience=1, learning_rate=1e3),
        threads=1,
    )
    with pytest.raises(InputError, match="diverged"):
        fit_model(job, lambda _: None, lambda: False)
    assert not out.exists()


@pytest.mark.parametrize(("cores", "threads"), [(None, 1), (1, 1), (2, 2), (16, 2)])
def test_a_training_alone_takes_two_threads_where_there_are_two_cores(
    cores: int | None, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    assert default_threads() == threads


CLOSE = 2e-5
"""Float32 over 20 ticks, sums in another order; logits are of size 1 to 20."""


def forward_of(checkpoint: Checkpoint) -> PatchForward:
    return PatchForward(checkpoint.arrays, checkpoint.card.hyper)


def torch_logits(model: PatchNet, rows: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return model(torch.from_numpy(rows[None].copy()))[0].numpy()


@pytest.mark.parametrize(
    "shape", [NetworkShape(258, 256, 2, 177), NetworkShape(6, 5, 1, 3), NetworkShape(252, 33, 3, 7)]
)
def test_equals_torch_on_random_weights_and_inputs(shape: NetworkShape) -> None:
    rng = np.random.default_rng(shape.hidden)
    model = new_model(shape, 3).eval()
    mean, scale = rng.normal(size=(2, shape.inputs)).astype(np.float32)
    model.set_normaliser(Normaliser(mean, np.abs(scale) + 0.1))
    forward = PatchForward(model.arrays(), shape)
    for _ in range(20):
        rows = rng.normal(scale=3.0, size=(20, shape.inputs)).astype(np.float32)
        ours = forward.logits(forward.run(rows, forward.start))
        assert np.abs(ours - torch_logits(model, rows)).max() < CLOSE


@pytest.mark.parametrize("piece", ["pot", "mushroom", "barrel"])
def test_equals_torch_on_the_shipped_models(piece: str) -> None:
    checkpoint = load_checkpoint(shipped_model(piece))
    forward, model = forward_of(checkpoint), load_network(checkpoint)
    rng = np.random.default_rng(5)
    mean, scale = checkpoint.arrays["mean"], checkpoint.arrays["scale"]
    for size in (0.3, 1.0, 3.0):
        # Walks that grow from zero, as a press does, in the units of the channels.
        walk = np.cumsum(rng.normal(scale=size / 4, size=(20, 258)), axis=0)
        rows = (mean + scale * walk).astype(np.float32)[
            :, modality_columns(checkpoint.card.modality)
        ]
        ours = forward.logits(forward.run(rows, forward.start))
        theirs = torch_logits(model, rows)
        assert np.abs(ours - theirs).max() < CLOSE * max(1.0, np.abs(theirs).max())


@pytest.mark.parametrize("cut", [1, 10, 19])
def test_a_sequence_can_be_cut_anywhere(cut: int) -> None:
    shape = NetworkShape(12, 16, 2, 4)
    forward = PatchForward(new_model(shape, 1).arrays(), shape)
    rows = np.random.default_rng(2).normal(size=(20, 12)).astype(np.float32)
    begun = forward.run(rows[:cut], forward.start)
    kept = begun.hidden.copy()
    in_two = forward.logits(forward.run(rows[cut:], begun))
    assert np.allclose(in_two, forward.logits(forward.run(rows, forward.start)), atol=1e-6)
    assert np.array_equal(begun.hidden, kept)
    assert not forward.start.hidden.any()


def test_an_estimator_needs_no_torch() -> None:
    code = (
        "import sys\n"
        "from touchdown.backend.bench.assembly import shipped_model\n"
        "from touchdown.backend.geometry.pieces import load_pieces\n"
        "from touchdown.backend.placement.estimator import Estimator\n"
        "Estimator.load(shipped_model('pot'), load_pieces().piece('pot'))\n"
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, cwd=Path(__file__).resolve().parents[3]
    )
    assert done.returncode == 0


def bits(*rows: str) -> np.ndarray:
    return np.array([[c == "1" for c in row] for row in rows])


def test_iou_is_a_mean_over_samples_and_an_empty_union_counts_one() -> None:
    assert iou(bits("1100", "0000", "1000"), bits("0110", "0000", "0001")) == pytest.approx(
        (1 / 3 + 1 + 0) / 3
    )
    assert point_accuracy(bits("1100", "0000"), bits("0110", "0000")) == pytest.approx(6 / 8)


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(8, 10, 0.490, 0.943), (40, 60, 0.541, 0.773), (34, 60, 0.441, 0.684), (0, 0, 0.0, 1.0)],
)
def test_wilson_intervals_as_published(k: int, n: int, low: float, high: float) -> None:
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=5e-4)


MOUNTINGS = [f"m{k}" for k in range(100)]


@pytest.mark.parametrize("n", [1, 12, 60, 299, 2760])
def test_without_events_the_bound_is_exact(n: int) -> None:
    """Against scipy; none of 299 is at most 1 %."""
    least = binomtest(0, n, alternative="less").proportion_ci(0.95, "exact")
    most = binomtest(n, n, alternative="greater").proportion_ci(0.95, "exact")
    assert rate_interval(0, n) == pytest.approx((0.0, least.high))
    assert rate_interval(n, n) == pytest.approx((most.low, 1.0))
    two_sided = binomtest(1, n + 1).proportion_ci(0.95, "wilson")
    assert rate_interval(1, n + 1) == pytest.approx((two_sided.low, two_sided.high), abs=1e-6)
    assert rate_interval(0, 299)[1] == pytest.approx(0.01, abs=5e-5)


def test_an_interval_by_mounting_covers_the_rate() -> None:
    """40 mountings of 12 presses, rates between mountings by a beta distribution.

    The interval covers the rate in 95 % of the draws and is that of a bootstrap of mountings; one
    over presses is too narrow.
    """
    rng = np.random.default_rng(8)
    mounting = np.repeat(MOUNTINGS[:40], 12).tolist()
    covered, naive = [], []
    for _ in range(400):
        right = rng.random(480) < np.repeat(rng.beta(3.0, 1.0, 40), 12)
        low, high = clustered_interval(right, mounting)
        covered.append(low <= 0.75 <= high)
        low, high = rate_interval(int(right.sum()), 480)
        naive.append(low <= 0.75 <= high)
    assert 0.925 <= np.mean(covered) <= 0.98
    assert np.mean(naive) < 0.8
    share = right.reshape(40, 12).mean(axis=1)
    oracle = bootstrap((share,), np.mean, n_resamples=4000, rng=9).confidence_interval
    assert clustered_interval(right, mounting) == pytest.approx(oracle, abs=0.012)


def test_mountings_of_one_press_are_independent_presses() -> None:
    right = np.arange(40) < 30
    assert clustered_interval(right, MOUNTINGS[:40]) == rate_interval(30, 40)
    # One mounting tells no more than one trial, however often it was pressed.
    assert clustered_interval(right, ["m"] * 40) == wilson_interval(0.75, 1)
    assert clustered_interval(np.ones(40, np.bool_), ["m", "n"] * 20) == rate_interval(2, 2)


def test_hull_margin_agrees_with_shapely() -> None:
    rng = np.random.default_rng(8)
    assert [hull_margin_mm(np.zeros((count, 2))) for count in range(3)] == [-math.inf] * 3
    for _ in range(300):
        points = rng.integers(-6, 7, (rng.integers(3, 12), 2)).astype(float)
        hull = MultiPoint(points).convex_hull
        got = hull_margin_mm(points)
        if hull.area == 0:
            assert got == -math.inf
            continue
        distance = hull.exterior.distance(Point(0, 0))
        sign = 1 if hull.covers(Point(0, 0)) else -1
        assert got == pytest.approx(sign * distance, abs=1e-5)


def test_scores_of_a_known_case() -> None:
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    points = np.stack([x.ravel(), y.ravel()], 1)
    left, right, whole = x.ravel() < -0.5, x.ravel() > 0.5, np.ones(9, bool)
    truth = np.stack([left, right, whole, whole])
    assert stable_flags(truth, points).tolist() == [False, False, True, True]
    probability = np.stack([whole, right, whole, left]) * 0.96 + 0.02
    got = score(probability, truth, points, 0.9, MOUNTINGS[: len(truth)])
    assert got.stability_accuracy == 0.5
    assert got.unsafe == 0.5
    assert got.base_rate == 0.5
    assert got.iou == pytest.approx((3 / 9 + 1 + 1 + 3 / 9) / 4)
    # confident enough to be contact, not enough to be support
    assert score(probability * 0.9, truth, points, 0.9, MOUNTINGS[: len(truth)]).unsafe == 0.0


PRECISION = "bfloat16" if computes_bfloat16(torch.device("cpu")) else "float32"
Data = Callable[[Path, int], Path]


def test_train_then_evaluate(
    tmp_path: Path, write_data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_data(tmp_path / "data", 36)
    out = tmp_path / "pot.safetensors"
    words = ["train", str(data), "--piece", "pot", "--out", str(out), "--epochs", "3"]
    words += ["--batch", "4", "--threads", "1", "--precision", PRECISION]
    assert main([*words, "--json"]) == 0
    captured = capsys.readouterr()
    answer = json.loads(captured.out)
    assert answer["episodes"] == 36
    assert answer["out"] == str(out)
    assert load_card(out).training["precision"] == PRECISION
    assert [point["epoch"] for point in answer["curve"]] == [1, 2, 3]
    assert captured.err == ""

    assert main(["evaluate", str(out), str(data), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert set(answer["scores"]) == {"circle15", "short", "all"}
    assert answer["scores"]["all"]["episodes"] == 36
    assert answer["scores"]["all"]["point_accuracy"] > 0.9
    low, high = answer["scores"]["all"]["stability_interval"]
    assert low <= answer["scores"]["all"]["stability_accuracy"] <= high

    assert main(["evaluate", str(out), str(data)]) == 0
    assert "circle15" in capsys.readouterr().out
    for delta in ("nan", "1", "-0.1"):
        assert main(["evaluate", str(out), str(data), "--delta", delta]) == 2
        assert f"No point has a probability above {delta.rstrip('0')}" in capsys.readouterr().err


def test_evaluate_adds_a_calibration_to_a_card_without_one(
    tmp_path: Path, write_data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = write_data(tmp_path / "data", 36), tmp_path / "pot.safetensors"
    words = ["train", str(data), "--out", str(out), "--epochs", "1", "--threads", "1"]
    assert main([*words, "--batch", "16"]) == 0
    trained = load_card(out)
    assert trained.calibration is not None
    assert trained.calibration.probes == trained.data["held_out"]
    card = json.loads(card_path(out).read_text())
    del card["calibration"]
    card_path(out).write_text(json.dumps(card))
    assert load_card(out).calibration is None

    assert main(["evaluate", str(out), str(data), "--calibrate"]) == 0
    assert "temperature" in capsys.readouterr().out
    fitted = load_card(out).calibration
    assert fitted is not None
    assert fitted.probes == 36
    assert load_card(out).model_copy(update={"calibration": None}) == trained.model_copy(
        update={"calibration": None}
    )


@pytest.mark.parametrize(
    ("extra", "where"),
    [(["--epochs", "0"], "arguments"), (["--modality", "smell"], "touchdown train")],
)
def test_bad_arguments_are_one_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str], where: str
) -> None:
    assert main(["train", str(tmp_path), *extra, "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert json.loads(captured.err)["error"]["where"] == where


def test_a_script_gets_the_numbers_of_the_command_line(
    tmp_path: Path, write_data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_data(tmp_path / "data", 36)
    by_verb, by_call = tmp_path / "verb.safetensors", tmp_path / "call.safetensors"
    words = ["train", str(data), "--out", str(by_verb), "--epochs", "2", "--modality", "FT"]
    assert main([*words, "--batch", "4", "--threads", "1", "--json"]) == 0
    curve = json.loads(capsys.readouterr().out)["curve"]
    reports: list[object] = []
    card = train_model(
        str(data), "pot", str(by_call), epochs=2, modality="FT", batch=4, threads=1,
        on_report=reports.append,
    )  # fmt: skip
    assert card == load_card(by_verb) == load_card(by_call)
    told = [r.validation_loss for r in reports if isinstance(r, TrainingEpoch)]
    assert told == [point["validation_loss"] for point in curve]
    assert isinstance(reports[-1], TrainingFinished)

    assert main(["evaluate", str(by_verb), str(data), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["scores"]
    assert {name: s.as_json() for name, s in evaluate(by_call, str(data)).items()} == shown


def test_a_training_from_a_script_names_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="epochs"):
        train_model(tmp_path, "pot", tmp_path / "pot.safetensors", epochs=0)
    with pytest.raises(InputError) as missing:
        train_model(tmp_path / "none", "pot", tmp_path / "pot.safetensors")
    assert missing.value.where == str(tmp_path / "none")
    with pytest.raises(InputError, match="folder"):
        train_model(tmp_path, "pot", tmp_path)


TrainingProcessData = Callable[[Path], Path]


def job(data: Path, out: Path, **changes: object) -> TrainingJob:
    settings = TrainingSettings(hidden=12, epochs=3, batch=8, validation_share=0.25)
    fields = {"data": data, "piece": "pot", "out": out, "settings": settings, "threads": 1}
    return TrainingJob.model_validate(fields | changes)


@pytest.mark.cold_start
def test_the_child_trains_and_equals_training_here(
    tmp_path: Path, write_data: TrainingProcessData
) -> None:
    data = write_data(tmp_path / "data")
    out = tmp_path / "pot.safetensors"
    with TrainingProcess(job(data, out)) as training:
        reports = list(training.reports())
    assert [type(r) for r in reports] == [TrainingLoaded, *3 * [TrainingEpoch], TrainingFinished]
    assert isinstance(reports[0], TrainingLoaded)
    assert (reports[0].episodes, reports[0].points, reports[0].kept_together) == (24, 177, "series")
    card = load_checkpoint(out).card
    assert card.data["episodes"] == {"circle15": 12, "short": 12}
    assert not resume_path(out).exists()

    here = tmp_path / "here.safetensors"
    told: list[object] = []
    fit_model(job(data, here), told.append, lambda: False)
    assert told[:-1] == reports[:-1]
    assert here.read_bytes() == out.read_bytes()


def test_the_child_ends_with_its_parent_block(
    tmp_path: Path, write_data: TrainingProcessData
) -> None:
    settings = TrainingSettings(hidden=12, epochs=100_000, patience=100_000, batch=8)
    endless = job(write_data(tmp_path / "data"), tmp_path / "pot.safetensors", settings=settings)
    with TrainingProcess(endless) as training:
        next(training.reports())
    assert training._child.returncode is not None


def test_bad_input_of_the_child_is_an_input_error_here(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"not at all")
    with (
        TrainingProcess(job(tmp_path, tmp_path / "pot.safetensors")) as training,
        pytest.raises(InputError, match="not an MCAP file") as error,
    ):
        list(training.reports())
    assert error.value.where == str(tmp_path / "bad.mcap")


def test_a_wrong_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="safetensors"):
        fit_model(job(tmp_path, tmp_path / "pot.pt"), lambda _: None, lambda: False)


@pytest.fixture
def shifted(pot: Piece, tmp_path: Path) -> Callable[..., Path]:
    """Write episodes of a bench whose torque has an offset and a smaller gain."""

    def write(name: str, offset: float, gain: float, seed: int) -> Path:
        points, rng = face_points(pot.face), np.random.default_rng(seed)
        packed = []
        for i in range(60):
            side = 1.0 if rng.random() < 0.5 else -1.0
            observation = rng.normal(size=(20, 258)).astype(np.float32)
            observation[:, 256] += np.float32(gain * side + offset)
            label = {
                "episode": f"{name}{i}", "x_um": 0, "y_um": 0, "sigma_um": 0, "piece": pot.name,
                "source": "commanded", "bottom": "short",
                "patch": patch_hex(points[:, 0] * side >= 0),
                "points": len(points), "geometry": pot.sha256, "grip_id": f"g{name}{i // 3}",
                "mounting_id": f"m{name}{i // 6}", "person": "simulated", "seed": i,
            }  # fmt: skip
            packed.append(PackedEpisode(observation, label))
        write_packs(tmp_path / name, "w", iter(packed), {"test": "yes"})
        return tmp_path / name

    return write


def fine_tune(job_: TrainingJob) -> ModelCard:
    fit_model(job_, lambda _: None, lambda: False)
    return load_card(job_.out)


def test_fine_tuning_adapts_a_model_to_a_shifted_bench(
    tmp_path: Path,
    shifted: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nominal, lab = shifted("nominal", 0.0, 8.0, 1), shifted("lab", 6.0, 4.0, 2)
    first, tuned = tmp_path / "pot.safetensors", tmp_path / "tuned.safetensors"
    fitted = TrainingSettings(
        modality="FT", hidden=12, epochs=12, batch=8, learning_rate=0.01, validation_share=0.25
    )
    origin = fine_tune(job(nominal, first, settings=fitted))
    tuning = job(lab, tuned, settings=fitted, pretrained=first)
    monkeypatch.setattr(fitting, "only_simulated", lambda rows: False)  # real probes
    card = fine_tune(tuning)
    assert card.simulated  # as the checkpoint, until it is evaluated on real probes

    validation = card.metrics["validation"]
    assert validation["loss"] < 0.5 * validation["pretrained"]["validation_loss"]
    assert card.data["pretrained"] == {"weights_sha256": origin.weights_sha256, "data": origin.data}
    fresh = evaluate(tuned, shifted("later", 6.0, 4.0, 3))["all"].iou
    assert fresh > evaluate(first, tmp_path / "later")["all"].iou + 0.2
    # inputs keep the scale of the checkpoint
    before, after = (load_checkpoint(path).arrays for path in (first, tuned))
    assert all(np.array_equal(before[name], after[name]) for name in ("mean", "scale"))
    assert not np.array_equal(before["head.weight"], after["head.weight"])

    again = tmp_path / "again.safetensors"
    mixed = {"mix": nominal, "mix_share": 0.25}
    fine_tune(tuning.model_copy(update={"out": again}))
    assert again.read_bytes() == tuned.read_bytes()
    with_mix = fine_tune(tuning.model_copy(update={"out": again, **mixed}))
    counts = (with_mix.data["held_out"], with_mix.data["mixed"]["episodes"])
    assert counts == (card.data["held_out"], round((60 - card.data["held_out"]) / 3))
    assert main(["evaluate", str(again), str(lab)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"Fine-tuned from the model {origin.weights_sha256[:12]}" in shown
    assert f"{counts[1]} of the training probes were mixed in." in shown
    coarse = ["--learning-rate", "1", "--epochs", "1", "--out", str(tmp_path / "worse.safetensors")]
    assert main(["train", str(lab), "--from", str(tuned), *coarse]) == 0
    assert "No epoch was better: the weights are those of" in capsys.readouterr().out


def test_a_checkpoint_that_does_not_fit_is_not_fine_tuned(
    tmp_path: Path, write_data: TrainingProcessData, pot: Piece
) -> None:
    data, path = write_data(tmp_path / "data"), tmp_path / "old.safetensors"
    out = tmp_path / "new.safetensors"
    barrel = load_pieces().piece("barrel")
    cases = [
        (barrel, {}, {}, "of 'barrel', not of 'pot'"),
        (pot, {"geometry": "ab" * 32}, {}, "another version"),
        (pot, {"vector_order": "wrench first"}, {}, "channels are ordered"),
        (pot, {"modality": "Tac"}, {"modality": "FT"}, "sees Tac, the training asks for FT"),
    ]
    for piece, card, asked, words in cases:
        write_model(path, piece, **{"modality": "FT+Tac", **card})
        with pytest.raises(InputError, match=words):
            fine_tune(make_training_job(data, "pot", out, asked, pretrained=path))
    write_model(path, pot)
    usual = make_training_job(data, None, out, {}, pretrained=path)
    assert (usual.piece, usual.settings.learning_rate) == ("pot", 1e-4)
    with pytest.raises(InputError, match="needs 18"):
        fine_tune(usual.model_copy(update={"mix": data, "mix_share": 0.9}))
    with pytest.raises(InputError, match="are held out for validation"):
        fine_tune(usual.model_copy(update={"mix": data, "mix_share": 0.5}))
    path.write_bytes(path.read_bytes()[:-4] + b"oops")
    with pytest.raises(InputError, match="damaged"):
        fine_tune(usual)
    with pytest.raises(InputError, match="replace its checkpoint"):
        make_training_job(data, None, path, {}, pretrained=path)
    assert not out.exists()


class TrainingHere:
    """A training in this process, which takes milliseconds."""

    calls = 0

    def __init__(self, job: TrainingJob) -> None:
        self.job = job

    def __enter__(self) -> "TrainingHere":
        return self

    def __exit__(self, *_: object) -> None:
        TrainingHere.calls += 1

    def reports(self) -> list[object]:
        found: list[object] = []
        fit_model(self.job, found.append, lambda: False)
        return found


def test_a_sweep_keeps_the_best_model_and_repeats_no_training(
    tmp_path: Path, write_data: Data, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setattr(training_runs, "TrainingProcess", TrainingHere)
    data, out = write_data(tmp_path / "data", 36), tmp_path / "best.safetensors"
    words = ["train", str(data), "--out", str(out), "--batch", "4", "--executor", "serial"]
    words += ["--sweep", "learning-rate=3e-3,1e-9", "--sweep", "modality=FT", "--json"]
    words += ["--epochs", "1"]
    answers = []
    for more in (["--shard", "0/2"], ["--shard", "1/2"], []):
        assert main([*words, *more]) == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert [answer["missing"] for answer in answers] == [1, 0, 0]
    assert TrainingHere.calls == 2
    good, bad = answers[-1]["sweep"]
    assert good["model"] == "learning_rate=0.003 modality=FT"
    assert good["iou"] > bad["iou"]
    assert (answers[0]["out"], answers[-1]["out"]) == (None, str(out))
    alone = tmp_path / "alone.safetensors"
    train_model(data, "pot", alone, modality="FT", batch=4, threads=1, epochs=1, learning_rate=3e-3)
    assert load_card(out).weights_sha256 == load_card(alone).weights_sha256
    assert main([*words, "--sweep", "speed=3"]) == 2
    assert main([*words, "--resume"]) == 2
