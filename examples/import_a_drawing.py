"""
A drawing becomes a piece
=========================

Read the outline of a part from an SVG drawing, keep it as a piece, and stack a pot on it. The
command line does the same with ``touchdown piece add plate.svg``.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import touchdown as td
from touchdown.backend.geometry import PieceImport, measure_piece, save_piece

drawing = """<svg xmlns="http://www.w3.org/2000/svg" width="30mm" height="24mm" viewBox="0 0 30 24">
<path fill-rule="evenodd" d="M0 0H30V16L22 24H0Z M8 8V16H16V8Z"/></svg>"""

with tempfile.TemporaryDirectory() as folder:
    source = Path(folder) / "drawing.svg"
    source.write_text(drawing, "utf-8")
    wanted = PieceImport(role="bottom", density_g_cm3=1.24, height_mm=20.0)
    measured = measure_piece(source, wanted)
    save_piece(measured, "plate", folder=Path(folder))
    method = td.StackSettings(fused={"weights": "any"})  # networks for outlines with holes
    with td.simulated_bench(pieces=Path(folder), method=method) as bench:
        request = td.StackRequest(piece="pot", bottoms=("plate",), strategy="fused", seed=1)
        result = bench.run(request)
    plate = td.load_pieces(Path(folder)).bottom("plate")
x_mm, y_mm, _ = measured.com_mm
print(f"{measured.mass_g:.1f} g, centre of mass at {x_mm:.2f}, {y_mm:.2f} mm")
print(result.trials[0].outcome.value, "after", result.trials[0].probes, "probes")

# %%
# The centre of mass follows from the outline with its hole, for a uniform density.

figure, axes = plt.subplots(figsize=(5, 4.2))
axes.plot(*plate.upper.path().T, color="C0")
axes.plot(*plate.com_xy_mm, "k+", markersize=12, label="centre of mass")
axes.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
axes.legend()
plt.show()
