"""Export of a dataset in a named format.

The folder is named ``.partial`` until the manifest is written. The module of a format is imported
when it is used.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Literal, cast

from touchdown.backend.annotations import DISK_FULL_ERRNOS, Dataset
from touchdown.backend.core import Fault, FaultError, InputError, sync_folder, write_atomically
from touchdown.backend.exchange import export_episode, manifest
from touchdown.backend.exchange.export_episode import ExportEpisode, ExportSignals
from touchdown.backend.exchange.features import COMMANDED, MEASURED, Feature, make_features
from touchdown.backend.exchange.query import (
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

    ``pictures``: include the tactile images at the ticks; ``tables``: include the recorded signals
    at their own rates.
    """

    dataset: Dataset
    chosen: tuple[SelectedEpisode, ...]
    features: tuple[Feature, ...]
    signals: ExportSignals
    pictures: bool
    advance: ProgressCallback
    tables: bool = False

    def episodes(self) -> Iterator[ExportEpisode]:
        """Yield the episodes in order, one in memory at a time."""
        for done, one in enumerate(self.chosen):
            yield export_episode.read_export(
                self.dataset, one, self.signals, pictures=self.pictures
            )
            self.advance(done + 1)


# Writes a format into an empty folder; returns the encoding of the values, for the manifest.
FormatWriter = Callable[[ExportJob, Path], Mapping[str, object]]


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """One export format.

    ``signals``: it holds arrays; otherwise labels only, with optional ``tables`` of the recorded
    signals.
    """

    name: str
    write: FormatWriter
    signals: bool
    video: Video = "none"
    tables: bool = False


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
    tables: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> ExportResult:
    """Export episodes and labels of a dataset; same as ``touchdown export``.

    The folder gets a manifest with the query, the split, the geometry and the hash of every file.
    An interrupted export leaves a folder whose name ends in ``.partial``.

    Parameters
    ----------
    dataset : Dataset, Path or str
        Open dataset, or its folder, which is then opened for reading.
    format : {"lerobot", "robomimic", "zarr", "coco", "csv", "jsonl"}
        File format. The last three hold labels and no signals, except for ``tables``.
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
    tables : bool
        With "csv": also write wrench, markers and poses of every episode at their own rates.
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
    query = ExportQuery(
        piece, bottom, series, campaign, tuple(states), held_out, seed, divide_series
    )
    chosen = export_format(format, tables=tables)
    with ExitStack() as stack:
        if not isinstance(dataset, Dataset):
            dataset = stack.enter_context(Dataset.open(dataset, create=False, write=False))
        return export_dataset(dataset, chosen, query, Path(out), video, on_progress)


def export_dataset(
    dataset: Dataset,
    chosen_format: ExportFormat,
    query: ExportQuery,
    out: Path,
    video: Video | None = None,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> ExportResult:
    """Write the episodes of ``query`` to the new folder ``out``; ``advance(done, total)``.

    Raises ``InputError`` for an invalid query, ``FaultError`` if the disk fails.
    """
    wanted = chosen_format.video if video is None else video
    selection = select_episodes(dataset, query)
    _check_video(chosen_format, selection.chosen, wanted)
    job = replace(_job(dataset, chosen_format, selection), tables=chosen_format.tables)
    part = _begin(out)
    try:
        described = manifest.make_manifest(
            dataset, chosen_format.name, query, selection, job.features
        )
        _write(job, chosen_format, described, wanted, part, advance)
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


def _job(dataset: Dataset, chosen_format: ExportFormat, selection: Selection) -> ExportJob:
    chosen = selection.chosen
    if not chosen_format.signals:
        return ExportJob(dataset, chosen, (), ExportSignals(False, False), False, lambda done: None)
    signals = export_episode.common_signals(dataset, chosen)
    listed = make_features(export_episode.face_points(dataset, chosen), native=signals.native)
    return ExportJob(dataset, chosen, listed, signals, False, lambda done: None)


def _check_video(
    chosen_format: ExportFormat, chosen: Sequence[SelectedEpisode], video: Video
) -> None:
    if video != "none" and not chosen_format.signals:
        raise InputError(
            f"The format '{chosen_format.name}' holds no pictures.", "--video", "Leave it out."
        )
    without = len(chosen) - len(_filmed(chosen))
    if video == "all" and without:
        raise InputError(
            f"{without} episodes were kept without pictures.",
            "--video all",
            "Use --video sample, which takes those that have some.",
        )


def _filmed(chosen: Sequence[SelectedEpisode]) -> list[SelectedEpisode]:
    return [one for one in chosen if one.entry.keep_frames != "none"]


def _begin(out: Path) -> Path:
    """Return the empty ``.partial`` folder; the rest of an interrupted export is removed."""
    if out.exists() or out.name.endswith(PARTIAL):
        raise InputError("This folder is there already, or has a kept name.", str(out),
                         "Name a new folder.")  # fmt: skip
    part = out.with_name(out.name + PARTIAL)
    if part.exists():
        if not ((part / MARK).is_file() or (part / manifest.MANIFEST_NAME).is_file()):
            raise InputError("This is no interrupted export.", str(part), "Move it away.")
        shutil.rmtree(part)
    try:
        part.mkdir(parents=True)
        (part / MARK).touch()
    except OSError as error:
        raise InputError(
            f"Nothing can be written there: {error.strerror or error}.",
            str(part),
            "Name a folder on a disk with room that can be written.",
        ) from error
    return part


def _write(
    job: ExportJob,
    chosen_format: ExportFormat,
    described: manifest.Manifest,
    video: Video,
    part: Path,
    advance: Callable[[int, int], None],
) -> None:
    """Write all files but the manifest, and describe them in ``described``."""
    filmed = _filmed(job.chosen)
    sample = _sample(filmed) if video == "sample" else ()
    total = len(job.chosen) + len(sample)
    for name in described["geometry"]:
        record = job.dataset.geometry.folder / f"{name}.json"
        write_atomically(part / manifest.GEOMETRY / record.name, record.read_bytes())
    whole = replace(job, pictures=video == "all", advance=lambda done: advance(done, total))
    codec = {"": dict(chosen_format.write(whole, part))}
    if sample:
        before = len(job.chosen)
        sampled = replace(
            job, chosen=sample, pictures=True, advance=lambda done: advance(before + done, total)
        )
        (part / SAMPLE).mkdir()
        codec[SAMPLE] = dict(chosen_format.write(sampled, part / SAMPLE))
    described["codec"] = codec
    if job.signals.native:
        described["feature_spec"]["action"] = COMMANDED if job.signals.commanded else MEASURED
    described["video"] = {"kind": video, "sampled": [one.entry.uuid for one in sample]}
    described["warnings"] += _warnings(job, chosen_format)


def _sample(filmed: Sequence[SelectedEpisode]) -> tuple[SelectedEpisode, ...]:
    count = min(SAMPLE_SIZE, len(filmed))
    picked = [filmed[k * len(filmed) // count] for k in range(count)]
    return tuple(replace(one, index=index) for index, one in enumerate(picked))


def _warnings(job: ExportJob, chosen_format: ExportFormat) -> list[str]:
    if not chosen_format.signals:
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


TABLES = ("csv",)  # formats with optional tables of the recorded signals
_MODULES: dict[str, tuple[str, bool, Video]] = {
    "lerobot": ("lerobot_v3", True, "sample"),
    "robomimic": ("robomimic", True, "none"),
    "zarr": ("zarr_v3", True, "none"),
    "coco": ("coco", False, "none"),
    "csv": ("csv_tables", False, "none"),
    "jsonl": ("jsonl", False, "none"),
}
EXPORTS = tuple(_MODULES)


def export_format(name: str, *, tables: bool = False) -> ExportFormat:
    """Return the format ``name``; raises ``InputError`` if it is unknown.

    ``tables``: include the recorded signals of every episode (csv only).
    """
    if name not in _MODULES:
        raise InputError(
            f"There is no format '{name}'.", "format", f"Use one of: {', '.join(EXPORTS)}."
        )
    if tables and name not in TABLES:
        raise InputError(
            f"The format '{name}' holds no tables of signals.", "--tables",
            f"Use {' or '.join(TABLES)}.",
        )  # fmt: skip
    module, signals, video = _MODULES[name]
    write = cast("FormatWriter", import_module(f"touchdown.backend.exchange.{module}").write)
    return ExportFormat(name, write, signals, video, tables)
