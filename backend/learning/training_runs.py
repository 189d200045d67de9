"""Trainings of a dataset, each in a child process and recorded as a run.

The parent process writes the record: parameters, curves, model.
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from touchdown.backend.annotations import (
    ActiveRun,
    CheckProgress,
    Dataset,
    LabelChoice,
    NotWritableError,
    RunInfo,
    RunTracker,
    is_dataset,
    is_run_alive,
    no_progress,
    read_metrics,
    read_run_info,
    run_folders,
)
from touchdown.backend.config import TrainingSettings, parse_settings
from touchdown.backend.core import (
    FaultError,
    InputError,
    disk_errors,
    program_version,
    read_json_lines,
)
from touchdown.backend.jobs import JobContext, JobSpec
from touchdown.backend.learning.checkpoint import ModelCard, load_card
from touchdown.backend.learning.inference import Modality
from touchdown.backend.learning.metrics import ReliabilityBin, calibration_error
from touchdown.backend.learning.training_process import (
    DeviceName,
    ReportCallback,
    TrainingCancelled,
    TrainingEpoch,
    TrainingFinished,
    TrainingJob,
    TrainingLoaded,
    TrainingProcess,
    TrainingReport,
    default_threads,
)

KIND = "train"
MODEL, RESUME, RELIABILITY = "model.safetensors", "model.resume.safetensors", "reliability.jsonl"
UNFINISHED = ("cancelled", "failed", "interrupted")

Curve = tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class TrainingRun:
    """One training. ``curves``: (epoch, value) by metric; ``card`` of the finished model.

    ``state`` is that of ``about``, except that a run without a process is interrupted.
    """

    folder: Path
    about: RunInfo
    state: str
    curves: Mapping[str, Curve] = field(default_factory=dict)
    reliability: Mapping[int, tuple[ReliabilityBin, ...]] = field(default_factory=dict)
    card: ModelCard | None = None
    can_resume: bool = False

    @property
    def uuid(self) -> str:
        """Id of the run."""
        return self.about.uuid

    @property
    def piece(self) -> str:
        """Grasped piece; "" before the end of a training that names none."""
        return self.card.piece if self.card else str(self.about.params.get("piece") or "")

    @property
    def model(self) -> Path:
        """Path of the weights of a finished run."""
        return self._made()[0]

    def with_card(self) -> TrainingRun:
        """Return the run with the card of its model, unless the file is gone or a later one."""
        model, sha256 = self._made()
        with suppress(InputError):
            card = load_card(model)
            return replace(self, card=card) if sha256 in ("", card.weights_sha256) else self
        return self

    def _made(self) -> tuple[Path, str]:
        """Return path and hash ("": unknown) of the weights; `train` writes them to its --out."""
        for made in self.about.artifacts:
            if made.name == "model":
                return self.folder.parents[1] / made.path, made.sha256
        return self.folder / MODEL, ""

    @property
    def best_epoch(self) -> int:
        """Epoch of the lowest validation loss; 0 before the first."""
        losses = self.curves.get("validation_loss", ())
        return min(losses, key=lambda at: at[1])[0] if losses else 0

    def value(self, name: str, epoch: int) -> float:
        """Return a metric at an epoch, NaN if it is missing."""
        return dict(self.curves.get(name, ())).get(epoch, math.nan)


def list_training_runs(data: Path) -> list[TrainingRun]:
    """Return the trainings on ``data``, newest first; other folders are skipped."""
    found = []
    for folder in run_folders(data):
        with suppress(InputError):
            found.append(read_training_run(folder))
    runs = [run for run in found if run.about.kind == KIND]
    return sorted(runs, key=lambda run: run.about.started_ns, reverse=True)


def read_training_run(folder: Path) -> TrainingRun:
    """Read one run; raises ``InputError`` if its ``run.json`` cannot be read."""
    about = read_run_info(folder)
    state: str = about.state
    if state == "running" and not is_run_alive(folder):
        state = "interrupted"
    made = TrainingRun(folder, about, state, _curves(folder), _bins(folder / RELIABILITY))
    if state == "finished":
        return made.with_card()
    return replace(made, can_resume=state in UNFINISHED and (folder / RESUME).is_file())


def _curves(folder: Path) -> dict[str, Curve]:
    curves: dict[str, list[tuple[int, float]]] = {}
    for metric in read_metrics(folder):
        curves.setdefault(metric.name, []).append((metric.step, metric.value))
    return {name: tuple(points) for name, points in curves.items()}


def _bins(path: Path) -> dict[int, tuple[ReliabilityBin, ...]]:
    found: dict[int, tuple[ReliabilityBin, ...]] = {}
    for line in read_json_lines(path):
        with suppress(ValueError, KeyError, TypeError):
            bins = tuple((float(p), float(share), int(n)) for p, share, n in line["bins"])
            found[int(line["epoch"])] = bins
    return found


# fields of ``TrainingEpoch`` stored as metrics
CURVES = ("train_loss", "validation_loss", "iou", "point_accuracy")
CALIBRATION = "calibration_error"


def record_report(run: ActiveRun, report: TrainingReport) -> None:
    """Store a report of the training; the last one ends the run."""
    match report:
        case TrainingLoaded():
            facts = report.model_dump(mode="json", include={"episodes", "held_out", "base_rate"})
            for name, value in facts.items():
                run.metric(name, 0, value)
        case TrainingEpoch():
            for name in CURVES:
                run.metric(name, report.epoch, getattr(report, name))
            run.metric(CALIBRATION, report.epoch, calibration_error(report.reliability))
            record_reliability(run, report.epoch, report.reliability)
            run.end_epoch()
        case TrainingFinished():
            for name, path in (("model", report.out), ("card", report.out.with_suffix(".json"))):
                run.artifact(name, path)
            run.finish(load_card(report.out).manifest_sha256)
        case TrainingCancelled():
            run.cancel()


def run_training(
    job: TrainingJob,
    on_report: ReportCallback,
    on_notice: Callable[[str], None] = lambda text: None,
    progress: CheckProgress = no_progress,
) -> str | None:
    """Train in a child process, recorded as a run of the dataset; return the id of the run.

    None for a folder of packs, which keeps no runs. ``on_notice`` receives the notices of the
    dataset after the run, ``progress`` that of its opening. Raises ``InputError`` for invalid data,
    ``FaultError`` if the child process dies.
    """
    with record_training(job, on_notice, progress) as run:
        kept = job if run is None else job.model_copy(update={"keep": run.folder})
        with TrainingProcess(kept) as training:
            for report in training.reports():
                if run is not None:
                    record_report(run, report)
                on_report(report)
    return None if run is None else run.uuid


_DEFAULTS = TrainingSettings()
FINE_TUNING_RATE = 1e-4  # a tenth of the rate of a training from scratch [U]


def train_model(  # noqa: PLR0913 - each is a keyword of the public API
    data: Path | str,
    piece: str | None,
    out: Path | str,
    *,
    epochs: int = _DEFAULTS.epochs,
    modality: Modality | None = None,
    seed: int = 0,
    batch: int = _DEFAULTS.batch,
    learning_rate: float | None = None,
    pretrained: Path | str | None = None,
    mix: Path | str | None = None,
    mix_share: float = 0.5,
    labels: LabelChoice = "approved",
    divide_series: bool = False,
    resume: bool = False,
    threads: int | None = None,
    device: DeviceName = "auto",
    on_report: ReportCallback | None = None,
) -> ModelCard:
    """Train a contact-patch model and return its card; same as ``touchdown train``.

    The training runs in a child process at low priority, and a dataset records it as a run. The
    call returns when the model is written. After an interruption, ``resume=True`` continues after
    the last complete epoch. The same data, settings and number of threads give the same weights.

    Parameters
    ----------
    data : Path or str
        Dataset, or folder of packs written by ``touchdown simulate --out``.
    piece : str or None
        Name of the grasped piece; None if the data hold a single piece.
    out : Path or str
        Model file (``.safetensors``). The card is written beside it (``.json``).
    epochs : int
        Passes over the training episodes. The epoch of lowest validation loss is kept.
    modality : {"FT", "Tac", "FT+Tac"}, optional
        Input of the network: wrench, markers or both (default: as ``pretrained``, else both).
    seed : int
        Seed of the initial weights, the order of the episodes and the split.
    batch : int
        Episodes per step.
    learning_rate : float, optional
        Step size of the optimiser (default: 1e-4 with ``pretrained``, else 1e-3).
    pretrained : Path or str, optional
        Model file to fine-tune. It sets the sizes, the modality and the normalisation.
    mix : Path or str, optional
        Data of which episodes are added to the training side, for example simulated ones.
    mix_share : float
        Share of the added episodes in the training side (0 to 1, both excluded).
    labels : {"approved", "submitted", "drafts"}
        Labels of a dataset to train on. Packs hold final labels.
    divide_series : bool
        Hold out whole grips instead of whole series.
    resume : bool
        Continue an interrupted training of the same model file.
    threads : int, optional
        Processor threads (default: 2 where there are two cores).
    device : {"auto", "cpu", "cuda"}
        Processor or graphics processor; "auto" uses CUDA if torch finds it.
    on_report : callable, optional
        Receives ``TrainingLoaded``, one ``TrainingEpoch`` per epoch and ``TrainingFinished``.

    Returns
    -------
    ModelCard
        Card of the written model, with its validation metrics.

    Raises
    ------
    InputError
        If the data, a setting or a model file cannot be used, or the training diverges.
    FaultError
        If the child process dies.

    Examples
    --------
    >>> card = train_model("probes", "pot", "pot.safetensors", epochs=8)  # doctest: +SKIP
    >>> card.metrics["validation"]["iou"]  # doctest: +SKIP
    0.6381

    """
    settings = {
        "modality": modality,
        "epochs": epochs,
        "batch": batch,
        "learning_rate": learning_rate,
        "divide_series": divide_series,
        "seed": seed,
    }
    job = make_training_job(
        Path(data), piece, Path(out), settings,
        labels=labels, resume=resume, threads=threads, device=device,
        pretrained=pretrained, mix=mix, mix_share=mix_share,
    )  # fmt: skip
    run_training(job, on_report or (lambda report: None))
    return load_card(job.out)


def variant_job(job: TrainingJob) -> JobSpec:
    """Return the job of ``train_variant`` for one training of a sweep.

    Its id depends on the names, sizes and times of the episodes and labels of ``data`` and ``mix``.
    """
    digest = sha256()
    for folder in filter(None, (job.data, job.mix)):
        for path in sorted({*folder.rglob("*.mcap"), *folder.glob("labels/*")}):
            about = path.stat()
            digest.update(f"{path} {about.st_size} {about.st_mtime_ns}\0".encode())
    params = job.model_dump(mode="json", exclude={"out", "keep", "resume"})
    return JobSpec("variant", params, inputs=(digest.hexdigest(),), code=program_version())


def train_variant(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Train one model of a sweep into the job's folder; the answer is the report of its end."""
    content = {**spec.params, "out": place.folder / MODEL}
    with TrainingProcess(parse_settings(TrainingJob, content, "job")) as training:
        *_, last = training.reports()
    return last.model_dump(mode="json", exclude={"out", "kind"})


def make_training_job(
    data: Path, piece: str | None, out: Path, settings: Mapping[str, object], **options: object
) -> TrainingJob:
    """Return the job for ``settings`` (``TrainingSettings``) and ``options`` (``TrainingJob``).

    Settings may be None. Raises ``InputError`` for a bad value, or if ``out`` cannot be written.
    """
    chosen = {name: value for name, value in settings.items() if value is not None}
    for name in ("pretrained", "mix"):
        options[name] = options.get(name) and Path(str(options[name])).resolve()
    if isinstance(start := options["pretrained"], Path):
        if start == out.resolve():
            what, fix = "The new model would replace its checkpoint.", "Choose another --out."
            raise InputError(what, str(out), fix)
        card = load_card(start)
        sizes = {"hidden": card.hyper.hidden, "layers": card.hyper.layers}
        chosen = {"modality": card.modality, "learning_rate": FINE_TUNING_RATE} | sizes | chosen
        piece = piece or card.piece
    if options.get("threads") is None:
        options["threads"] = default_threads()
    job = {
        "data": data.resolve(),
        "piece": piece,
        "out": _checked_model_file(out.resolve()),
        "settings": parse_settings(TrainingSettings, chosen, "arguments"),
        **options,
    }
    return parse_settings(TrainingJob, job, "arguments")


def _checked_model_file(out: Path) -> Path:
    if out.is_dir():
        raise InputError("This is a folder, not a file.", str(out), "Name a .safetensors file.")
    folder = next(place for place in out.parents if place.exists())
    fix = "Name a file in a folder that you may write to (--out)."
    with (
        disk_errors("The model cannot be written there", folder, fix),
        tempfile.TemporaryFile(dir=folder) as file,
    ):
        file.write(b"touchdown")
    return out


def record_reliability(run: ActiveRun, epoch: int, bins: object) -> None:
    """Append the reliability bins of an epoch."""
    with (run.folder / RELIABILITY).open("a", encoding="utf-8") as file:
        file.write(json.dumps({"epoch": epoch, "bins": bins}) + "\n")


@contextmanager
def record_training(
    job: TrainingJob, say: Callable[[str], None], progress: CheckProgress = no_progress
) -> Iterator[ActiveRun | None]:
    """Record ``job`` as a run of the dataset ``job.data``; yields None for a folder of packs.

    The dataset may be open elsewhere. An exception ends the run as failed. Afterwards the catalogue
    is updated, with ``progress``, and ``say`` receives the notices; if another program has the
    dataset open, that program updates it.
    """
    if not is_dataset(job.data):
        yield None
        return
    recorded = {"piece", "out", "labels", "resume", "threads", "pretrained", "mix", "mix_share"}
    parameters = job.model_dump(mode="json", include=recorded)
    run = _begin(job.data, job.settings, parameters)
    try:
        with run:
            yield run
    finally:
        with (
            suppress(NotWritableError),
            Dataset.open(job.data, create=False, progress=progress) as dataset,
        ):
            for notice in dataset.notices:
                say(notice)


@dataclass(frozen=True, slots=True)
class TrainingRequest:
    """Training on the episodes of ``piece`` in ``data``; ``labels``: labels of a dataset to use.

    ``resumed_run``: unfinished run with the same data and settings, to continue from its epochs.
    """

    data: Path
    piece: str
    settings: TrainingSettings
    labels: LabelChoice = "approved"
    resumed_run: TrainingRun | None = None


def resume_request(run: TrainingRun, data: Path) -> TrainingRequest:
    """Return the request that continues ``run``; raises ``InputError`` if it cannot."""
    if not run.can_resume:
        what, fix = "The run cannot be continued: no whole epoch was kept.", "Start a new training."
        raise InputError(what, str(run.folder), fix)
    params: Mapping[str, Any] = run.about.params
    known = {name: params[name] for name in TrainingSettings.model_fields if name in params}
    settings = TrainingSettings.model_validate(known)
    return TrainingRequest(data, str(params["piece"]), settings, params["labels"], run)


class RecordedTraining:
    """One training. ``reports`` runs on one thread; ``cancel`` is thread-safe."""

    def __init__(self, request: TrainingRequest) -> None:
        self._request = request
        resumed = {} if request.resumed_run is None else {"resumed": request.resumed_run.uuid}
        parameters = {"piece": request.piece, "labels": request.labels, **resumed}
        self._run = _begin(request.data, request.settings, parameters)
        self._child: TrainingProcess | None = None
        self._cancelled = self._killed = False
        self._lock = threading.Lock()

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self._run.folder

    @property
    def pid(self) -> int | None:
        """Process id of the child, None if there is none."""
        with self._lock:
            return None if self._child is None else self._child.pid

    def reports(self) -> Iterator[TrainingReport]:
        """Train, and yield each report after it was stored.

        Raises ``InputError`` for invalid input, ``FaultError`` if the child dies.
        """
        with self._run as run:
            job = self._job()
            with TrainingProcess(job) as child:
                with self._lock:
                    self._child = child
                    if self._cancelled:
                        child.cancel()
                try:
                    for report in child.reports():
                        record_report(run, report)
                        yield report
                except FaultError:
                    # A killed training counts as cancelled.
                    if not self._killed:
                        raise
                finally:
                    with self._lock:
                        self._child = None

    def cancel(self) -> None:
        """Stop after the current batch; whole epochs are kept for a resume."""
        with self._lock:
            self._cancelled = True
            if self._child is not None:
                self._child.cancel()

    def kill(self) -> None:
        """Cancel and kill the child; whole epochs are kept, the current one is lost."""
        self.cancel()
        with self._lock:
            self._killed = True
            if self._child is not None:
                self._child.kill()

    def _job(self) -> TrainingJob:
        request, out = self._request, self._run.folder / MODEL
        if request.resumed_run is not None:
            shutil.copyfile(request.resumed_run.folder / RESUME, self._run.folder / RESUME)
            for name, values in request.resumed_run.curves.items():
                for step, value in values:
                    self._run.metric(name, step, value)
            for epoch, bins in request.resumed_run.reliability.items():
                record_reliability(self._run, epoch, bins)
            self._run.end_epoch()
        return TrainingJob(
            data=request.data,
            piece=request.piece,
            out=out,
            settings=request.settings,
            labels=request.labels,
            resume=request.resumed_run is not None,
            keep=self._run.folder,
        )


def _begin(data: Path, settings: TrainingSettings, parameters: Mapping[str, Any]) -> ActiveRun:
    params = {**parameters, **settings.model_dump(mode="json")}
    fix = "Make room, or give the account the right to write there."
    with disk_errors("No run can be kept there", data, fix):
        if is_dataset(data):
            with Dataset.open(data, create=False, write=False) as dataset:
                return dataset.runs.begin(KIND, seed=settings.seed, settings=params)
        return RunTracker(data, dict).begin(KIND, seed=settings.seed, settings=params)
