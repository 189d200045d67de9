"""Split by gripping, replay gate, and the parameters that follow from a fitted press model."""

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.identification.test_identify import (
    LIBRARY,
    NOMINAL,
    RAMP,
    fitted,
    made_press,
    made_set,
)
from touchdown.backend.config import ProbeSettings
from touchdown.backend.core import InputError
from touchdown.backend.identification import Estimate
from touchdown.backend.identification.fitting import FitResult, Layout
from touchdown.backend.identification.press_model import PressModel, field_basis, unknowns_of
from touchdown.backend.identification.stages import (
    Mechanics,
    StageStore,
    dilation_estimate,
    dragged,
    finger_decays,
    fit_friction,
    friction_estimates,
    judged_presses,
    replay_gate,
    split_grips,
)
from touchdown.backend.simulation import build_gel


def test_growth_with_the_pad_force_follows_from_the_lateral_force():
    """Fy presses one pad and relieves the other; a growth of both pads alike does not count."""
    rng, rolls = np.random.default_rng(2), (7.5, 6.5)
    made = made_set(np.zeros((24, 2)), RAMP * (0.0, 0.0, -1.0), grips=np.arange(24) // 4)
    lateral = np.linspace(-1.5, 1.5, 24)
    strain = np.array([[0.1, 1.0, 0.01], [0.1, 0.9, 0.01]]) * np.ones((24, 1, 1))
    normal = 10.0 + lateral[:, None] * (0.5, -0.5) + 0.3
    gel = build_gel((0.058, 0.062), 1.9, rolls, 0.03)
    field = gel.displacement_px(strain, normal, np.full(24, 10.0))[:, None]
    made.wrench[..., 1] = lateral[:, None]
    made = replace(made, field_px=field + 0.02 * rng.standard_normal((24, 20, 2, 63, 2)))
    layout = Layout(unknowns_of(NOMINAL), made.mounting, made.grip)
    x = layout.vector(lambda u: float(u.inner({"scale_left": 1 / 0.058, "scale_right": 1 / 0.062}
                                              .get(u.name, u.start))))  # fmt: skip
    fit = FitResult(x, np.zeros((len(x), len(x))), np.ones(len(x)), 1.0, 1.0, 0.1)
    mechanics = Mechanics(made, layout, fit, np.array(rolls), np.zeros((2, 2)), converged=True)
    found = dilation_estimate(made, mechanics, 1.9)
    assert found.value == pytest.approx(0.03, rel=0.05)
    assert found.low < 0.03 < found.high


def test_the_decay_of_each_gel_is_found_by_itself():
    rng, rolls = np.random.default_rng(6), ((7.0, 6.0), (8.5, 5.0))
    made = made_set(np.zeros((12, 2)), RAMP * (0.0, 0.0, -1.0), grips=np.arange(12) // 2)
    strain = np.array([[0.3, 1.0, 0.02], [0.3, 0.9, -0.02]]) * rng.uniform(0.8, 1.2, (12, 1, 1))
    gels = [build_gel((0.058, 0.062), 1.9, roll, 0.0) for roll in rolls]
    left, right = (gel.displacement_px(strain, np.full((12, 2), 10.0), np.full(12, 10.0))
                   for gel in gels)  # fmt: skip
    field = np.stack([left[:, 0], right[:, 1]], axis=1)[:, None]
    made = replace(made, field_px=field + 0.05 * rng.standard_normal((12, 20, 2, 63, 2)))
    layout = Layout(unknowns_of(NOMINAL), made.mounting, made.grip)
    x = np.zeros(layout.size)
    fit = FitResult(x, np.zeros((len(x), len(x))), x, 1.0, 1.0, 0.1)
    found = Mechanics(made, layout, fit, np.full(2, 6.5), np.zeros((2, 2)), converged=True)
    decays = [Estimate(**one) for one in finger_decays(found, 1.9)["of"]]
    assert [e.key for e in decays] == [f"decay.{f}.{a}" for f in ("left", "right") for a in "xz"]
    assert {e.stage for e in decays} == {3}
    for one, true in zip(decays, np.ravel(rolls), strict=True):
        assert one.value == pytest.approx(true, rel=0.02)
        assert one.low < true < one.high


def test_whole_grippings_are_held_out_from_every_mounting():
    recordings = [made_press(k) for k in range(24)]
    presses = made_set(np.zeros((24, 2)), RAMP * (0.0, 0.0, -1.0), grips=np.arange(24) // 4)
    presses = replace(presses, recordings=tuple(recordings), mounting=np.arange(24) // 12)
    fitted, held = split_grips(presses)
    assert set(presses.grip[held]) == {2, 5}
    assert not set(presses.grip[held]) & set(presses.grip[fitted])
    with pytest.raises(InputError, match="held out"):
        split_grips(presses.take(np.arange(8)))


def test_the_first_presses_of_a_gripping_predict_the_others():
    presses = made_set(np.zeros((8, 2)), RAMP * (0.0, 0.0, -1.0), grips=[0, 0, 0, 0, 1, 1, 2, 3])
    first, judged = judged_presses(presses)
    assert (first.tolist(), judged.tolist()) == ([0, 1, 4], [2, 3, 5])
    with pytest.raises(InputError, match="two valid presses"):
        judged_presses(presses.take(np.array([6, 7])))


@pytest.mark.slow
def test_the_gate_judges_what_a_bench_can_know():
    """A held-out gripping 20 % stiffer than the mean counts against neither bench."""
    offsets = [(5, 1), (-4, 3), (2, -6), (-6, -3), (4, 4), (-2, 5)]
    presses = made_set(offsets, RAMP * (0.0, 0.0, -0.8), piece="pot", bottom="square15",
                       grips=[0, 1, 2, 2, 2, 2])  # fmt: skip
    presses = replace(presses, contact_mm=np.full(6, 30.0))
    model = PressModel(presses, NOMINAL, LIBRARY)
    layout = Layout(unknowns_of(NOMINAL), presses.mounting, presses.grip)
    x = layout.vector(lambda u: float(u.inner(u.start)))
    x[layout.parts["shear"]] += np.log([0.9, 1.1, 1.2])
    x[layout.parts["normal_ratio"]] += np.log(1.5)
    seen = model.predict(layout.values(x))
    basis = field_basis(NOMINAL.tactile.pitch_mm, NOMINAL.tactile.roll_off_mm)
    amplitude = seen[..., 6:].reshape(6, 20, 2, 3)
    rng = np.random.default_rng(0)
    field = np.einsum("btfi,fima->btfma", amplitude, basis[:, :3])
    noise = np.repeat([1e-2, 4e-4], 3) * rng.standard_normal((6, 20, 6))
    presses = replace(presses, wrench=seen[..., :6] + noise,
                      field_px=field + 0.05 * rng.standard_normal(field.shape))  # fmt: skip
    fitted, held = presses.take(np.array([0, 1])), presses.take(np.arange(2, 6))
    layout = Layout(unknowns_of(NOMINAL), fitted.mounting, fitted.grip)
    x = layout.vector(lambda u: float(u.inner(u.start)))
    x[layout.parts["shear"]] += np.log([0.9, 1.1])
    x[layout.parts["normal_ratio"]] += np.log(1.5)
    nothing = np.zeros((len(x), len(x)))
    fit = FitResult(x, nothing, np.full(len(x), 0.01), 1.0, 1.0, 0.1)
    roll_off = np.array(NOMINAL.tactile.roll_off_mm)
    found = Mechanics(fitted, layout, fit, roll_off, np.zeros((2, 2)), converged=True)
    gate = replay_gate(held, found, NOMINAL, LIBRARY, np.full(3, 1e-3))
    assert (gate.grips, gate.presses, gate.accepted) == (1, 2, True)
    assert gate.share < 0.3


def sliding(found, path, signs=(1, 1, 1, 1), grip_n=10.0, **own):
    """Return presses of a pot along ``path``, to the side of ``signs``, by the press model."""
    presses = made_set([(0, 0)] * len(signs), path, piece="pot", bottom="square15")
    motion = presses.motion_mm * np.array([(1, side, 1) for side in signs])[:, None]
    held = tuple(
        replace(one, probe=ProbeSettings(grip_force_n=grip_n)) for one in presses.recordings
    )
    presses = replace(
        presses, recordings=held, motion_mm=motion, contact_mm=np.full(len(signs), 30.0)
    )
    values = {u.name: np.full(len(signs), found.of(u.name)[0].mean()) for u in unknowns_of(NOMINAL)}
    wrench = PressModel(presses, NOMINAL, LIBRARY).predict({**values, **own})[..., :6]
    return replace(presses, wrench=wrench)


def test_the_friction_of_the_faces_is_the_ratio_of_the_forces_of_a_slide(tmp_path, monkeypatch):
    found, _ = fitted(monkeypatch, StageStore(tmp_path / "stages", "inputs"))
    mu, sides = np.array([0.22, 0.35, 0.5, 0.35]), np.array([1, -1, 1, -1])
    path = RAMP * (0.0, 0.9, -0.5)
    presses = sliding(found, path, sides, mu=mu)
    # Coulomb's law; the faces lie level.
    np.testing.assert_allclose(-sides * presses.wrench[:, -1, 1] / presses.wrench[:, -1, 2], mu,
                               rtol=0.01)  # fmt: skip
    assert dragged(presses).all()
    slid = fit_friction(presses, found, NOMINAL, LIBRARY)
    np.testing.assert_allclose(slid["mu"], mu, rtol=0.01)
    assert max(slid["sigma"]) < 0.03
    # The friction of a press that does not slide is unknown.
    stuck = sliding(found, RAMP * (0.0, 0.3, -0.9), mu=np.full(4, 0.6))
    assert fit_friction(stuck, found, NOMINAL, LIBRARY)["mu"] == []
    # A slope of the bottom counts with opposite signs on both sides, so the mean stays.
    x = found.fit.x.copy()
    x[found.layout.parts["tilt_x"]] = 0.02
    slope = replace(found, fit=replace(found.fit, x=x))
    leant = sliding(found, path, sides, mu=np.full(4, 0.35))
    turned = leant.wrench.copy()
    turned[..., 1:3] = leant.wrench[..., 1:3] @ [[1.0, 0.02], [-0.02, 1.0]]
    leant = fit_friction(replace(leant, wrench=turned), slope, NOMINAL, LIBRARY)
    assert abs(leant["mu"][0] - leant["mu"][1]) == pytest.approx(0.04 * (1 + 0.35**2), rel=0.1)
    assert np.mean(leant["mu"]) == pytest.approx(0.35, rel=0.01)
    spread = np.std([*found.of("tilt_x")[0] + 0.02, *found.of("tilt_y")[0]])
    assert leant["sigma"][0] == pytest.approx(spread * (0.35 + 1 / 0.35), rel=0.2)


def test_the_friction_of_the_pads_follows_from_a_press_in_which_they_slip(tmp_path, monkeypatch):
    found, _ = fitted(monkeypatch, StageStore(tmp_path / "stages", "inputs"))
    mu = np.array([0.5, 0.62, 0.8, 0.62])
    presses = sliding(found, RAMP * (0.0, 0.0, -1.7), grip_n=4.0, mu_grip=mu)
    assert not dragged(presses).any()
    slipped = fit_friction(presses, found, NOMINAL, LIBRARY)
    np.testing.assert_allclose(slipped["mu"], mu, rtol=0.03)
    pads, spread = friction_estimates("mu_grip", np.array(slipped["mu"]), np.full(4, 0.01))
    assert (pads.key, spread.key) == ("mu_grip", "spread.mu_grip")
    assert friction_estimates("mu", np.array([0.3, 0.4]), np.full(2, 0.01)) == []
