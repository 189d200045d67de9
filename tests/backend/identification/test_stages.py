"""Press model, fit, split, replay gate and bench file."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.identification.made import made_press, made_set
from touchdown.backend.annotations import Dataset
from touchdown.backend.cli.command_line import main
from touchdown.backend.config import load_simulation
from touchdown.backend.core import InputError
from touchdown.backend.experiments import identification_page
from touchdown.backend.experiments.document import SIMULATED, check_svg
from touchdown.backend.geometry import load_pieces
from touchdown.backend.identification.estimates import estimate
from touchdown.backend.identification.fitting import ChannelNoise, GlsFit, Layout
from touchdown.backend.identification.identify import (
    Identification,
    identified_settings,
    write_identification,
)
from touchdown.backend.identification.press_model import (
    PressModel,
    field_basis,
    project_fields,
    unknowns_of,
)
from touchdown.backend.identification.recordings import STEPS
from touchdown.backend.identification.sensors import Spectrum
from touchdown.backend.identification.stages import Gate, StageStore, split_grips
from touchdown.backend.simulation import build_gel

NOMINAL, LIBRARY = load_simulation(), load_pieces()
RAMP = np.minimum(1.0, np.arange(1, STEPS + 1) / 30.0)[:, None]


# Fx, Fz and T at the wrist of the mushroom on circle15, docs/bench-physics 3.8: end of the hold
@pytest.mark.parametrize(
    ("offset", "force", "moment"),
    [
        ((9, 0), (0.794, 0.0, 7.699), (0.0, -0.0943)),
        ((7, 7), (0.589, 0.795, 7.692), (0.0918, -0.0699)),
    ],
)
def test_the_model_agrees_with_the_published_vectors(offset, force, moment):
    # The table commands 1.5 mm to an arm of 30, 30, 15 N/mm; here the hand itself is prescribed.
    hand = np.array([force[0] / 30.0, force[1] / 30.0, force[2] / 15.0 - 1.5])
    presses = made_set([offset], RAMP * hand)
    values = {u.name: np.full(1, u.start) for u in unknowns_of(NOMINAL)} | {"alpha": np.zeros(1)}
    found = PressModel(presses, NOMINAL, LIBRARY).predict(values)[0, -1]
    assert found[:3] == pytest.approx(force, rel=0.01, abs=0.01)
    assert found[3:5] == pytest.approx(moment, rel=0.02, abs=5e-4)


def test_amplitudes_of_a_field_are_found_without_its_hidden_markers():
    gel = build_gel((1 / 17.0, 1 / 16.0), 1.9, (7.0, 6.0), 0.01)
    strain = np.array([[[0.1, -0.9, 0.01], [0.2, -0.8, -0.02]]])
    field = gel.displacement_px(strain, np.full((1, 2), 11.0), np.full(1, 10.0))
    seen = np.ones((1, 2, 63), bool)
    seen[:, :, :9] = False
    field[:, :, :9] = 99.0
    found, misfit = project_fields(field, seen, field_basis(1.9, (7.0, 6.0)))
    scale = np.array([17.0, 16.0])[:, None]
    np.testing.assert_allclose(found[0, :, :3], scale * strain[0], atol=1e-6)
    assert misfit.max() < 1e-9


@pytest.mark.slow
def test_a_fit_recovers_stiffness_and_scale():
    offsets = [(5, 1), (-4, 3), (2, -6), (-6, -3)]
    path = RAMP * (0.0, 0.0, -1.0)
    presses = made_set(offsets, path, piece="pot", bottom="square15", grips=[0, 0, 1, 1])
    presses = replace(presses, contact_mm=np.full(4, 30.0))
    unknowns = unknowns_of(NOMINAL)
    layout = Layout(unknowns, presses.mounting, presses.grip)
    model = PressModel(presses, NOMINAL, LIBRARY)
    start = layout.vector(lambda u: float(u.inner(u.start)))
    true = start.copy()
    true[layout.parts["shear"]] = np.log([5.5, 3.0])
    true[layout.parts["scale_left"]] = np.log([15.0, 18.0])
    noise = ChannelNoise(np.repeat([0.01, 4e-4, 0.02, 0.02], 3), np.full(12, 1e-4), np.zeros(12))
    fit = GlsFit(model, layout, model.predict(layout.values(true)), noise)
    found = fit.run(start, rounds=1, evaluations=4)
    for name in ("shear", "scale_left", "scale_right"):
        part = layout.parts[name]
        np.testing.assert_allclose(found.x[part], true[part], atol=0.05)
    assert (found.sigma[layout.parts["shear"]] < 0.02).all()


def test_whole_grippings_are_held_out_from_every_mounting():
    recordings = [made_press(k) for k in range(24)]
    presses = made_set(np.zeros((24, 2)), RAMP * (0.0, 0.0, -1.0), grips=np.arange(24) // 4)
    presses = replace(presses, recordings=tuple(recordings), mounting=np.arange(24) // 12)
    fitted, held = split_grips(presses)
    assert set(presses.grip[held]) == {2, 5}
    assert not set(presses.grip[held]) & set(presses.grip[fitted])
    with pytest.raises(InputError, match="held out"):
        split_grips(presses.take(np.arange(8)))


def test_a_finished_stage_is_not_computed_again(tmp_path):
    store = StageStore(tmp_path / "stages", "inputs")
    assert store.get("gel", lambda: {"x": [1.0]}) == {"x": [1.0]}
    assert store.get("gel", lambda: pytest.fail("computed twice")) == {"x": [1.0]}
    assert StageStore(tmp_path / "stages", "others").get("gel", lambda: {"x": []}) == {"x": []}


def test_a_bench_that_predicts_no_better_is_refused():
    table = np.ones((3, 8))
    gate = Gate(table, table, 0.4, 3, 4, 20, np.zeros((3, 20, 2)))
    assert gate.accepted
    assert not replace(gate, share=1.2).accepted
    assert not replace(gate, better=2).accepted


def test_only_sharp_estimates_enter_the_bench():
    estimates = (
        estimate("grasp.shear_n_mm", 5.0, 0.2), estimate("tactile.mm_per_px.1", 0.061, 0.001),
        estimate("grasp.torsion_nmm_rad", 300.0, 90.0), estimate("mu_grip", 0.6, 0.02),
        estimate("delay.pose_wrench", 0.02, 1e-3), estimate("grasp.hysteresis_share", 0.2, 0.01),
    )  # fmt: skip
    found, used = identified_settings(NOMINAL, estimates)
    assert used == ("grasp.shear_n_mm", "tactile.mm_per_px.1", "mu_grip", "grasp.hysteresis_share")
    assert (found.grasp.shear_n_mm, found.mu_grip) == (5.0, 0.6)
    assert found.grasp.hysteresis
    assert found.tactile.mm_per_px == (0.058, 0.061)
    assert found.grasp.torsion_nmm_rad == NOMINAL.grasp.torsion_nmm_rad


def made_identification(share):
    series = np.ones((3, 20, 2)) * np.arange(1.0, 4.0)[:, None, None]
    gate = Gate(np.full((3, 8), 9.0), np.full((3, 8), 2.0), share, 3, 3, 18, series)
    estimates = (estimate("grasp.shear_n_mm", 5.0, 0.2), estimate("wrist.white_n", 0.07, 1e-3))
    settings, used = identified_settings(NOMINAL, estimates)
    spectra = (Spectrum("wrist, N", "N", np.arange(1.0, 9.0), np.arange(1.0, 9.0)),)
    return Identification(
        settings, NOMINAL, estimates, used, gate, ("shear",), np.ones((1, 1)), spectra,
        (("frames", "10"),), (("mu", "a drag"),), 1.2, 54, 9, simulated=True,
    )  # fmt: skip


def test_the_result_is_a_bench_file_figures_and_a_page(tmp_path):
    found = made_identification(0.3)
    figures = write_identification(found, tmp_path / "lab.toml", "LAB")
    bench = load_simulation(tmp_path / "lab.toml")
    assert bench == found.settings
    assert bench.grasp.shear_n_mm == 5.0
    stored = json.loads(figures.read_text())
    assert stored["accepted"]
    assert stored["randomisation"]["grasp.shear_n_mm"] == pytest.approx([4.608, 5.392], abs=1e-3)
    page = identification_page(found, "LAB")
    for text in (found.reason, "grasp.shear_n_mm", "a drag", "Noise spectra", SIMULATED):
        assert text in page
    for svg in re.findall(r"<svg.*?</svg>", page, re.DOTALL):
        check_svg(svg)


def test_a_refused_bench_is_not_written(tmp_path):
    write_identification(made_identification(1.4), tmp_path / "lab.toml", "LAB")
    assert [path.name for path in tmp_path.iterdir()] == ["lab.json"]


def test_a_dataset_without_presses_is_refused_by_the_command(tmp_path, capsys):
    Dataset.open(tmp_path / "ds", person="ann").close()
    words = ["identify", str(tmp_path / "ds"), "--out", str(tmp_path / "lab.toml")]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "0 presses" in error
    assert "collect --plan gel" in error
