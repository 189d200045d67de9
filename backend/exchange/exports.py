"""Export of a dataset in a named format.

The folder is named ``.partial`` until the manifest is written. The module of a format is imported
when it is used.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Literal

from touchdown.backend.annotations import DISK_FULL_ERRNOS, Dataset
from touchdown.backend.core import (
    Fault,
    FaultError,
    InputError,
    disk_errors,
    sync_folder,
    write_atomically,
)
from touchdown.backend.exchange import export_episode, manifest
from touchdown.backend.exchange.export_episode import ExportEpisode, ExportSignals
from touchdown.backend.exchange.features import (
    ADDED,
    COMMANDED,
    MEASURED,
    STATE_WITH,
    Feature,
    make_features,
)
from touchdown.backend.exchange.query import (
    EXPORT_STATES,
    ExportQuery,
    ExportState,
    SelectedEpisode,
    Selection,
    select_episodes,
)

PARTIAL = ".partial"
MARK = ".touchdown-export"
SAMPLE = "sample"
SAMPLE_SIZE = 20  # number of episodes with images for ``video="sample"``, evenly spread
Video = Literal["sample", "all", "none"]
ProgressCallback = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class ExportJob:
    """Input of a format writer.

    ``pictures``: include the images at the ticks; ``tables``: include the recorded signals at their
    own rates; ``layout``: name of the format.
    """

    dataset: Dataset
    chosen: tuple[SelectedEpisode, ...]
    features: tuple[Feature, ...]
    signals: ExportSignals
    pictures: bool
    advance: ProgressCallback
    layout: str = ""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Keys of the pictures to write."""
        return self.signals.cameras if self.pictures else ()

    def episodes(self) -> Iterator[ExportEpisode]:
        """Yield the episodes in order, one in memory at a time."""
        for done, one in enumerate(self.chosen):
            yield export_episode.read_export(
                self.dataset, one, self.signals, pictures=self.pictures
            )
            self.advance(done + 1)


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """One export format, written by the function ``write(job, folder)`` of ``module``.

    ``write`` fills an empty folder and returns the encoding of the values, for the manifest.
    ``signals``: the format holds arrays; otherwise labels only. ``video``: images by default.
    """

    module: str
    signals: bool
    video: Video = "none"


FORMATS = {
    "lerobot": ExportFormat("lerobot_v3", signals=True, video="sample"),
    "robomimic": ExportFormat("robomimic", signals=True),
    "zarr": ExportFormat("zarr_arrays", signals=True),
    "replay-buffer": ExportFormat("zarr_arrays", signals=True),
    "coco": ExportFormat("coco", signals=False),
    "csv": ExportFormat("csv_tables", signals=False),
    "ros2": ExportFormat("rosbag2", signals=False),
}
EXPORTS = tuple(FORMATS)


@dataclass(frozen=True, slots=True)
class ExportResult:
    """Result of an export.

    Attributes
    ----------
    folder : Path
        Folder that holds the export.
    episodes : int
        Number of exported episodes.
    manifest_sha256 : str
        Hash of ``manifest.json``.
    warnings : tuple of str
        Restrictions of the export, a sentence each.

    Examples
    --------
    >>> ExportResult(Path("out"), 12, "", ()).episodes
    12
    """

    folder: Path
    episodes: int
    manifest_sha256: str
    warnings: tuple[str, ...]


def export(  # noqa: PLR0913 - each is a keyword of the public API
    dataset: Dataset | Path | str,
    format: str,
    out: Path | str,
    *,
    piece: str | None = None,
    bottom: str | None = None,
    series: str | None = None,
    campaign: str | None = None,
    states: Sequence[ExportState] = ("approved",),
    held_out: float = 0.2,
    seed: int = 0,
    divide_series: bool = False,
    video: Video | None = None,
    state_with: Sequence[str] = (),
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> ExportResult:
    """Export episodes and labels of a dataset; same as ``touchdown export``.

    The folder gets a manifest with the query, the split, the geometry and the hash of every file.
    An interrupted export leaves a folder whose name ends in ``.partial``.

    Parameters
    ----------
    dataset : Dataset, Path or str
        Open dataset, or its folder, which is then opened for reading.
    format : {"lerobot", "robomimic", "zarr", "replay-buffer", "coco", "csv", "ros2"}
        File format. ``coco`` and ``csv`` hold labels and no signals. ``ros2`` copies the episode
        files.
    out : Path or str
        New folder to write.
    piece, bottom, series, campaign : str, optional
        Export only the episodes of this piece, bottom, series or campaign.
    states : sequence of {"approved", "submitted", "draft"}
        Label states to export.
    held_out : float
        Share of the episodes (0 to below 1) on the validation side, in whole series or mountings.
        Tags of the dataset take precedence.
    seed : int
        Seed of the draw of the validation side.
    divide_series : bool
        Allow a pair of one series on both sides; the manifest then contains a warning.
    video : {"sample", "all", "none"}, optional
        Tactile images of 20 episodes, of all or of none (default: "sample" for LeRobot, else
        "none").
    state_with : sequence of {"wrench", "markers", "environment_state"}
        With "lerobot": signals that ``observation.state`` holds besides the pose, or with
        "environment_state" ``observation.environment_state`` instead.
    on_progress : callable, optional
        Receives the number of episodes written, and the number to write.

    Returns
    -------
    ExportResult
        Folder, number of episodes, SHA-256 of the manifest and warnings.

    Raises
    ------
    InputError
        If an argument is invalid, no episode passes the query, or ``out`` exists.
    FaultError
        If the disk is full or fails.

    Examples
    --------
    >>> result = export("probes", "lerobot", "probes-lerobot", piece="pot")  # doctest: +SKIP
    >>> result.episodes  # doctest: +SKIP
    1500

    """
    if format not in FORMATS:
        fix = f"Use one of: {', '.join(EXPORTS)}."
        raise InputError(f"There is no format '{format}'.", "format", fix)
    if isinstance(states, str) or not set(states) <= set(EXPORT_STATES):
        use = f"Give a tuple of names from: {', '.join(EXPORT_STATES)}."
        raise InputError(f"Labels cannot be chosen by {states!r}.", "--states", use)
    if seed < 0:
        raise InputError(f"The seed {seed} is negative.", "--seed", "Give 0 or a positive number.")
    query = ExportQuery(
        piece, bottom, series, campaign, tuple(states), held_out, seed, divide_series
    )
    wanted, out = video or FORMATS[format].video, Path(out)
    with ExitStack() as stack:
        if not isinstance(dataset, Dataset):
            dataset = stack.enter_context(Dataset.open(dataset, create=False, write=False))
        selection = select_episodes(dataset, query)
        _check_video(format, selection.chosen, wanted)
        job = _job(dataset, format, selection, tuple(state_with))
        part = _begin(out, dataset.folder)
        try:
            described = manifest.make_manifest(dataset, format, query, selection, job.features)
            _write(job, format, described, wanted, part, on_progress)
            manifest_sha256 = manifest.write_manifest(part, described)
            (part / MARK).unlink()
            part.replace(out)
            sync_folder(out.parent)
        except OSError as error:
            full = error.errno in DISK_FULL_ERRNOS
            fault = Fault(
                code="DISK-FULL" if full else "EXPORT-WRITE",
                what="The disk is full." if full else f"The export cannot be written: {error}.",
                consequence=f"The export is incomplete; {part.name} can be deleted.",
                next_step="Make room, then export again.",
            )
            raise FaultError(fault) from error
    return ExportResult(out, len(job.chosen), manifest_sha256, tuple(described["warnings"]))


def _job(
    dataset: Dataset, name: str, selection: Selection, state_with: tuple[str, ...]
) -> ExportJob:
    signals, features = ExportSignals(), tuple[Feature, ...]()
    if FORMATS[name].signals:
        signals = export_episode.common_signals(dataset, selection.chosen)
        signals = replace(signals, state_with=state_with)
    fits = name == "lerobot" and signals.native and {*ADDED} & {*state_with}
    if state_with and not (fits and {*state_with} <= {*STATE_WITH}):
        what, fix = f"The state cannot hold '{','.join(state_with)}'.", "Add wrench or markers to "
        fix += "the state of recorded episodes with lerobot, and environment_state if you like."
        raise InputError(what, "--state-with", fix)
    if FORMATS[name].signals:
        points = export_episode.face_points(dataset, selection.chosen)
        features = make_features(points, native=signals.native, state_with=state_with)
    common = (dataset, selection.chosen, features, signals)
    return ExportJob(*common, False, lambda done: None, name)


def _check_video(name: str, chosen: Sequence[SelectedEpisode], video: Video) -> None:
    if video != "none" and not FORMATS[name].signals:
        raise InputError(f"The format '{name}' has no videos.", "--video", "Leave it out.")
    without = len(chosen) - len(_filmed(chosen))
    if video == "all" and without:
        fix = "Use --video sample, which takes those that have some."
        raise InputError(f"Episodes kept without pictures: {without}.", "--video all", fix)


def _filmed(chosen: Sequence[SelectedEpisode]) -> list[SelectedEpisode]:
    return [one for one in chosen if one.entry.keep_frames != "none"]


def _begin(out: Path, dataset: Path) -> Path:
    """Return the empty ``.partial`` folder; the rest of an interrupted export is removed."""
    if dataset.resolve() in out.resolve().parents:
        fix = "Name a folder outside of it."
        raise InputError("The export would become a part of the dataset.", str(out), fix)
    if out.exists() or out.name.endswith(PARTIAL):
        raise InputError("This folder is there already, or has a kept name.", str(out),
                         "Name a new folder.")  # fmt: skip
    part = out.with_name(out.name + PARTIAL)
    if part.exists():
        if not ((part / MARK).is_file() or (part / manifest.MANIFEST_NAME).is_file()):
            raise InputError("This is no interrupted export.", str(part), "Move it away.")
        shutil.rmtree(part)
    fix = "Name a folder on a disk with room that can be written."
    with disk_errors("Nothing can be written there", part, fix):
        part.mkdir(parents=True)
        (part / MARK).touch()
    return part


def _write(
    job: ExportJob,
    name: str,
    described: manifest.Manifest,
    video: Video,
    part: Path,
    advance: Callable[[int, int], None],
) -> None:
    """Write all files but the manifest, and describe them in ``described``."""
    filmed = _filmed(job.chosen)
    sample = _sample(filmed) if video == "sample" else ()
    total = len(job.chosen) + len(sample)
    for pair in described["geometry"]:
        record = job.dataset.geometry.folder / f"{pair}.json"
        write_atomically(part / manifest.GEOMETRY / record.name, record.read_bytes())
    whole = replace(job, pictures=video == "all", advance=lambda done: advance(done, total))
    write = import_module(f"touchdown.backend.exchange.{FORMATS[name].module}").write
    codec = {"": dict(write(whole, part))}
    if sample:
        before = len(job.chosen)
        sampled = replace(
            job, chosen=sample, pictures=True, advance=lambda done: advance(before + done, total)
        )
        (part / SAMPLE).mkdir()
        codec[SAMPLE] = dict(write(sampled, part / SAMPLE))
    described["codec"] = codec
    if job.signals.native:
        described["feature_spec"]["action"] = COMMANDED if job.signals.commanded else MEASURED
    described["video"] = {"kind": video, "sampled": [one.entry.uuid for one in sample]}
    described["warnings"] += _warnings(job, name)


def _sample(filmed: Sequence[SelectedEpisode]) -> tuple[SelectedEpisode, ...]:
    count = min(SAMPLE_SIZE, len(filmed))
    picked = [filmed[k * len(filmed) // count] for k in range(count)]
    return tuple(replace(one, index=index) for index, one in enumerate(picked))


def _warnings(job: ExportJob, name: str) -> list[str]:
    if not FORMATS[name].signals:
        return []
    if not job.signals.native:
        return ["Some episodes have no recorded signals: the export holds the observations only."]
    action = "The action is the commanded pose of the next tick"
    if not job.signals.commanded:
        action = "Some episodes do not say the commanded pose: the action is the measured pose at "
        action += "the next tick"
    return [
        f"{action}; the orientation of the tool is fixed.",
        "All signals are at 10 Hz; native rates and time stamps are in the episode files only.",
    ]
