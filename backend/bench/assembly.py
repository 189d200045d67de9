"""Assembly of a session on the simulated bench from names and settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from touchdown.backend.bench.session import Session
from touchdown.backend.calibration import CalibrationStore
from touchdown.backend.config import (
    PRESETS,
    BenchDescription,
    BenchIdentity,
    SimulationSettings,
    StackSettings,
    bench_sha256,
    describe_simulation,
    load_simulation,
)
from touchdown.backend.core import InputError, Pose, RawStreams, program_version
from touchdown.backend.emulation import parse_script
from touchdown.backend.geometry import (
    Piece,
    PieceLibrary,
    Tower,
    can_be_placed,
    draw_start,
    draw_tower,
    face_points,
    load_pieces,
    start_generator,
    with_true_com,
)
from touchdown.backend.learning import ModelRegistry, card_mismatches, check_autonomous
from touchdown.backend.placement import Estimator, shipped_model
from touchdown.backend.runs import (
    NoEstimator,
    PatchEstimator,
    RecordingOptions,
    ReleaseVerdict,
    SceneChoice,
    SceneDevices,
    SceneView,
    calibrations_folder,
    models_folder,
)
from touchdown.backend.sensing import calibrate_scene_camera, gripper_payload
from touchdown.backend.simulation import Scene, judge_release, start_command_mm
from touchdown.backend.simulation.devices import SimulatedBench

if TYPE_CHECKING:
    from touchdown.backend.bench.emulated_scene import TruthClient

TOWERS = 100  # most draws of a tower on which the piece can stand
DIRECTIONS, MOST_STEPS = 32, 20  # rays and steps of the search for the least number of probes
JIG_MM = (-80.0, 0.0)  # position of the jig beside the bottom


@dataclass(frozen=True, slots=True)
class SimulatedBenchChoice:
    """Choice of a simulated bench: given settings, else a file, else a preset.

    ``disturbances`` are texts such as ``tactile_left:stop@3.0``. ``pieces`` is a folder with
    further piece files.
    """

    file: Path | None = None
    preset: str | None = None
    disturbances: tuple[str, ...] = ()
    pieces: Path | None = None
    given: SimulationSettings | None = None

    def settings(self) -> SimulationSettings:
        """Return the settings; raises ``InputError``."""
        if self.given is not None:
            return self.given
        if self.file is not None:
            if self.preset is not None:
                fix = "Give one of them."
                raise InputError("A settings file and a preset were both given.", "--preset", fix)
            return load_simulation(self.file)
        name = self.preset or "mixed"
        if name not in PRESETS:
            fix = f"Choose one of {', '.join(PRESETS)}."
            raise InputError(f"There is no preset '{name}'.", "--preset", fix)
        return SimulationSettings.model_validate({"preset": name})


@dataclass
class SimulatedScoring:
    """Ground truth of one scene for scoring and display, never for the method."""

    bench: SimulatedBench | TruthClient
    longest_step_mm: float
    animate: bool

    def start_mm(self) -> tuple[float, float]:
        """Return the true offset at the start."""
        return self.bench.scene.start_mm

    def least_probes(self) -> int:
        """Return 1 + the least number of longest steps from the start to a stable offset."""
        scene = self.bench.scene
        x, y = scene.start_mm
        for steps in range(MOST_STEPS):
            radius = steps * self.longest_step_mm
            angles = 2 * np.pi * np.arange(DIRECTIONS if steps else 1) / DIRECTIONS
            for angle in angles:
                for part in (1.0, 0.75, 0.5, 0.25) if steps else (1.0,):
                    reach = radius - (1.0 - part) * self.longest_step_mm
                    at = (x + reach * float(np.cos(angle)), y + reach * float(np.sin(angle)))
                    if judge_release(scene, at, 0.0, sign_only=True).stands:
                        return 1 + steps
        return 1 + MOST_STEPS

    def verdict(self) -> ReleaseVerdict:
        """Judge the present scene; if animated, the physics engine judges a release as well."""
        truth = self.bench.truth()
        if truth.stands is not None and self.animate:
            truth = self.bench.truth(animate=True)
        return ReleaseVerdict(
            bool(truth.stands), truth.knocked_over, truth.margin_mm, truth.fall, truth.contradicted,
            truth.kick_mm,
        )  # fmt: skip


class BenchModels:
    """Trained models of a bench; each file is read once per piece.

    Without a file in the choice the model in use of ``registry`` is loaded, else the shipped one. A
    run keeps the model it was checked with, whatever is promoted or deleted meanwhile. The next run
    reads a changed file again.
    """

    def __init__(
        self, registry: ModelRegistry | None, description: BenchDescription, grid_mm: float
    ) -> None:
        self._registry, self._description, self._grid_mm = registry, description, grid_mm
        self.since_ns = 0  # earlier evaluations on hardware do not count
        self._loaded: dict[tuple[Path, str], Estimator] = {}
        self._stamps: dict[Path, tuple[int, int] | None] = {}
        self._checked: dict[str, Path] = {}

    def of(self, choice: SceneChoice, piece: Piece) -> PatchEstimator:
        """Return the model of a scene, ``NoEstimator`` if it needs none; raises ``InputError``."""
        if not choice.estimates:
            return NoEstimator()
        path = self._path(choice, self._checked.get(choice.piece))
        return NoEstimator(face_points(piece.face)) if path is None else self._read(path, piece)

    def check(self, choice: SceneChoice, piece: Piece) -> Estimator | None:
        """Return the model of a new run; ``InputError`` if it must not run without approval."""
        if not choice.estimates:
            return None
        path = self._path(choice)
        if path is None:
            return None
        if self._stamps.get(path) != _stamp(path):
            self._loaded = {key: one for key, one in self._loaded.items() if key[0] != path}
        loaded = self._read(path, piece)
        if not choice.model:
            self._checked[choice.piece] = path
        if choice.alone:
            card = loaded.card
            probes = 0
            if self._registry is not None:
                probes = self._registry.hardware_probes(card.weights_sha256, self.since_ns)
            found = card_mismatches(card, self._description, piece.sha256, self._grid_mm, probes)
            check_autonomous(card, found, f"model {card.weights_sha256[:12]}")
        return loaded

    def _path(self, choice: SceneChoice, checked: Path | None = None) -> Path | None:
        """Return the file of the model, None if the piece has none and needs none."""
        if choice.model or checked:
            return Path(choice.model) if choice.model else checked
        try:
            return model_in_use(choice.piece, self._registry)
        except InputError:
            if choice.optional:
                return None
            raise

    def _read(self, path: Path, piece: Piece) -> Estimator:
        if (path, piece.name) not in self._loaded:
            self._stamps[path] = _stamp(path)
            self._loaded[path, piece.name] = Estimator.load(path, piece)
        return self._loaded[path, piece.name]


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return modification time and size of a file, None if there is none."""
    try:
        told = path.stat()
    except OSError:
        return None
    return told.st_mtime_ns, told.st_size


def model_in_use(piece: str, registry: ModelRegistry | None) -> Path:
    """Return the model in use for ``piece``, else the shipped one."""
    path = None if registry is None else registry.in_use(piece)
    return shipped_model(piece) if path is None else path


def run_record(bench: Mapping[str, object], model: Estimator | None) -> dict[str, object]:
    """Return ``bench`` with model and program version, as the event log stores them."""
    card = None if model is None else model.card
    return {
        **bench,
        "model": card and {"piece": card.piece, "weights_sha256": card.weights_sha256},
        "program": program_version(),
    }


def make_tower(
    catalogue: PieceLibrary, choice: SceneChoice, piece: Piece, rng: np.random.Generator
) -> Tower:
    """Stack the named bottoms; those above the first lean out at random.

    Drawn until ``piece`` can stand on it. Raises ``InputError`` for an unknown bottom or if no draw
    fits.
    """
    names = choice.bottoms
    if not names or not all(names):
        raise InputError("No bottom was named.", "--bottom", "Name one, such as short.")
    bottoms = tuple(map(catalogue.bottom, names))
    for _ in range(TOWERS):
        tower = draw_tower(rng, bottoms)
        if len(bottoms) == 1 or can_be_placed(piece, tower):
            return tower
    fix = "Choose another tower."
    raise InputError(f"'{piece.name}' cannot stand on it.", "+".join(names), fix)


def make_scene(catalogue: PieceLibrary, choice: SceneChoice, settings: SimulationSettings) -> Scene:
    """Return the scene of one trial; it depends on the choice and its seed only."""
    seed = choice.seed
    if seed < 0:
        raise InputError(f"The seed {seed} is negative.", "--seed", "Give 0 or a positive number.")
    piece = with_true_com(catalogue.top(choice.piece), seed)
    rng = start_generator(seed, choice.piece, *choice.bottoms)
    tower = make_tower(catalogue, choice, piece, rng)
    if not choice.jig:
        start = draw_start(rng, piece.body(), tower)
        return Scene(piece=piece, bottoms=tower, start_mm=start, seed=seed, settings=settings)
    # A jig holds the piece more precisely than a hand.
    grasp_mm = settings.spread.grasp_offset_mm if choice.handed else settings.spread.jig_mm
    spread = settings.spread.model_copy(update={"grasp_offset_mm": grasp_mm})
    return Scene(
        piece=piece,
        bottoms=tower,
        start_mm=JIG_MM,
        seed=seed,
        settings=settings.model_copy(update={"spread": spread}),
        mounting=choice.mounting,
        jig=True,
    )


def simulated_session(
    choice: SimulatedBenchChoice | None = None,
    *,
    keep: RecordingOptions | None = None,
    method: StackSettings | None = None,
    animate: bool = False,
    estimate: Callable[[SimulatedBench], PatchEstimator] | None = None,
    registry: ModelRegistry | None = None,
) -> Session:
    """Return a session on the simulated bench.

    >>> session = simulated_session()                                       # doctest: +SKIP
    >>> session.events.subscribe(print)                                     # doctest: +SKIP
    >>> session.run(StackRequest(piece="pot", bottoms=("short",), seed=7))  # doctest: +SKIP

    ``animate`` asks MuJoCo, where it is installed, after every release: for the motion of a fall
    and as second judge (0.4 s). ``estimate`` makes what stands in for the trained model on a new
    bench. ``registry`` knows the models in use (None: those that ship). Raises ``InputError`` for
    bad settings.
    """
    choice = choice or SimulatedBenchChoice()
    settings, disturbances = choice.settings(), choice.disturbances
    script = parse_script(disturbances)
    catalogue = load_pieces(choice.pieces)
    method = method or StackSettings()
    description = describe_simulation(settings)
    models = BenchModels(registry, description, method.belief.pitch_mm)

    def make_stage(choice: SceneChoice, raw: RawStreams) -> SceneDevices:
        scene = make_scene(catalogue, choice, settings)
        bench = SimulatedBench(scene, script, raw)
        return SceneDevices(
            clock=bench.clock,
            devices=bench.devices,
            arm=bench.arm,
            gripper=bench.gripper,
            piece=catalogue.top(choice.piece),  # without a drawn centre of mass
            bottom="+".join(choice.bottoms),
            advance=bench.advance,
            rests=bench.rests,
            scoring=SimulatedScoring(bench, method.policy.longest_step_mm, animate),
            estimator=estimate(bench) if estimate else models.of(choice, scene.piece),
            payload=gripper_payload(settings.wrist.payload_kg, settings.wrist.payload_com_mm),
            outline=scene.surface,
            jig=Pose(*start_command_mm(scene).tolist()) if scene.jig else None,
            scene_view=SceneView(bench.scene_picture, calibrate_scene_camera(bench.scene_picture()))
            if scene.jig
            else None,
        )

    def check(choice: SceneChoice) -> Mapping[str, object]:
        scene = make_scene(catalogue, choice, settings)
        loaded = None if estimate else models.check(choice, scene.piece)
        bench = {"simulation": settings.model_dump(mode="json"), "disturbances": [*disturbances]}
        return run_record(bench, loaded)

    session = Session(
        make_stage,
        check,
        catalogue,
        settings=method,
        keep=keep or RecordingOptions(),
        description=description,
    )
    if not disturbances:
        session.identity = BenchIdentity(settings.preset, bench_sha256(settings))
    return session


def simulated_bench(
    *,
    preset: str | None = None,
    settings: SimulationSettings | Path | str | None = None,
    disturbances: Sequence[str] = (),
    method: StackSettings | None = None,
    pieces: Path | str | None = None,
    runs: Path | str | None = None,
) -> Session:
    """Return a simulated bench, as ``touchdown stack`` uses it.

    Parameters
    ----------
    preset : {"mixed", "quiet", "hard", "off", "realistic", "bench-v1", "bench-v2"}, optional
        Named noise settings; "mixed" without preset and settings.
    settings : SimulationSettings, Path or str, optional
        Settings of the simulation, or a TOML file with them, instead of a preset.
    disturbances : sequence of str, optional
        Scripted disturbances such as ``"tactile_left:stop@3.0"``: device, effect, time in s.
    method : StackSettings, optional
        Settings of the method; defaults otherwise.
    pieces : Path or str, optional
        Folder with further piece files.
    runs : Path or str, optional
        Folder for the event logs and episodes of runs. Nothing is kept without it.

    Returns
    -------
    Session
        A context manager; ``run`` takes a request. Models and calibrations in use are those of
        the operator's data folder; without a model in use the one that ships is loaded.

    Raises
    ------
    InputError
        If a preset, a disturbance or a file is invalid.

    Examples
    --------
    >>> from touchdown.backend.bench import simulated_bench
    >>> from touchdown.backend.runs import StackRequest
    >>> with simulated_bench(preset="quiet") as bench:  # doctest: +SKIP
    ...     result = bench.run(StackRequest(piece="pot", bottoms=("short",), seed=7))
    >>> print(result.trials[0].outcome, result.trials[0].probes)  # doctest: +SKIP

    """
    choice = SimulatedBenchChoice(
        file=Path(settings) if isinstance(settings, Path | str) else None,
        preset=preset,
        disturbances=tuple(disturbances),
        pieces=Path(pieces) if pieces else None,
        given=None if isinstance(settings, Path | str) else settings,
    )
    keep, registry = RecordingOptions(Path(runs) if runs else None), ModelRegistry(models_folder())
    session = simulated_session(choice, keep=keep, method=method, registry=registry)
    session.calibrations = CalibrationStore(calibrations_folder(), "simulated")
    return session
