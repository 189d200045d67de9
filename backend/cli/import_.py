"""``touchdown import``: read episodes or labels from the format of another program."""

from __future__ import annotations

import argparse
from pathlib import Path

from touchdown.backend import exchange, experiments
from touchdown.backend.annotations import Dataset
from touchdown.backend.cli.dataset import dataset_to_fill
from touchdown.backend.cli.output import VerbOutput, check_output, person_of
from touchdown.backend.core import InputError, Recording, write_atomically
from touchdown.backend.runs import dataset_folder

EPISODES = ("lerobot", "mcap")
LABELS = ("coco", "csv")
MAP_FIX = "Name it (docs/exchange.md). A name that is no file yet gets a mapping to correct."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "format", choices=(*EPISODES, *LABELS),
        help="lerobot, mcap (ROS 2): new episodes; coco, csv: labels of episodes that are here",
    )  # fmt: skip
    parser.add_argument("source", metavar="SRC", type=Path, help="file or folder")
    parser.add_argument("--dataset", metavar="DIR", help="dataset (default: in the data folder)")
    parser.add_argument(
        "--person", metavar="NAME",
        help="author of the labels; needed for coco and csv (episodes without it: measured "
        "labels, entered under the account's name)",
    )  # fmt: skip
    parser.add_argument("--piece", help="grasped piece, if the file has none")
    parser.add_argument("--bottom", help="bottom, if the file has none")
    parser.add_argument(
        "--map", type=Path, metavar="TOML",
        help="lerobot, mcap: file that names signals, units and frames of a foreign recording",
    )  # fmt: skip
    parser.add_argument(
        "--preview", type=Path, metavar="HTML", help="draw one press as the mapping file reads it"
    )
    parser.add_argument(
        "--force", action="store_true", help="import presses that contradict the mapping file"
    )
    parser.add_argument(
        "--check", action="store_true", help="print the changes without making them"
    )


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Import; return 0 if everything was imported or already present, else 1."""
    if not args.source.exists():
        raise InputError("There is no such file or folder.", str(args.source), "Check the path.")
    if args.map is None and (args.format == "mcap" or args.preview):
        raise InputError("A mapping file is missing.", "--map", MAP_FIX)
    if args.map is not None and args.format not in EPISODES:
        raise InputError(f"{args.format} needs no mapping file.", "--map", "Remove it.")
    if args.preview:
        check_output(args.preview, ".html", args.source)
    if args.map is not None and not args.map.exists():
        text = exchange.propose_mapping(exchange.recording_contents(args.source))
        write_atomically(args.map, text.encode("utf-8"))
        screen.say(f"A mapping to correct is in {args.map}. Then repeat the command.")
        return 1
    if args.format in LABELS and not args.person:
        raise InputError("Labels need a person.", "--person", "Name who made them.")
    folder = Path(args.dataset) if args.dataset else dataset_folder()
    actor = person_of(args)
    with dataset_to_fill(folder, actor, screen, create=args.format in EPISODES) as dataset:
        if args.format in EPISODES:
            return _episodes(args, dataset, actor, screen)
        return _labels(args, dataset, screen)


def _episodes(args: argparse.Namespace, dataset: Dataset, actor: str, screen: VerbOutput) -> int:
    wish = exchange.ImportOptions(actor, args.person, args.piece, args.bottom, args.map)
    wanted = exchange.EpisodeImport(dataset, args.format, args.source, wish)
    with screen.progress("Reading", wanted.total) as advance:
        survey = wanted.survey(advance)
    screen.say(f"Episodes found: {survey.found}, present already: {survey.here}.")
    if survey.contradictions:
        screen.say("\n  ".join(["The signals contradict the mapping:", *survey.contradictions]))
    if args.preview and wanted.presses:
        page = _preview(wanted.presses[0].recording, args.source.name, survey.contradictions)
        write_atomically(args.preview, page.encode("utf-8"))
        screen.say(f"The first press is drawn in {args.preview}.")
    for why, count in survey.problems:
        screen.say(f"  {count} cannot be mapped: {why}.")
    for loss in survey.losses:
        screen.say(f"  {loss}")
    written, backup = list[str](), ""
    if survey.fit and not args.check and (args.force or not survey.contradictions):
        with screen.progress("Writing", survey.fit) as advance:
            written = wanted.write(advance)
        backup = _backup_text(wanted.backup, screen)
        screen.say(f"New episodes in {dataset.folder}: {len(written)}. Their labels are drafts.")
    screen.result({
        "found": survey.found,
        "here": survey.here,
        "written": len(written),
        "problems": [{"why": why, "episodes": count} for why, count in survey.problems],
        "losses": list(survey.losses),
        "contradictions": list(survey.contradictions),
        "backup": backup,
    })  # fmt: skip
    return 1 if survey.problems or not survey.found or survey.contradictions else 0


def _preview(press: Recording | None, name: str, findings: tuple[str, ...]) -> str:
    """Return an HTML page of the signals of one press, and what contradicts the mapping."""
    assert press is not None
    pictures = []
    for title, unit, axes, t_s, rows in exchange.press_curves(press):
        curves = dict(zip(axes, rows.T, strict=True))
        svg = experiments.curves_chart(title, t_s, curves, ("s", unit))
        pictures.append(experiments.ReportPicture(svg))
    about = (
        f"Time 0 is the contact. Fz in still air is {press.tare[2]:+.1f} N.",
        "In contact Fz rises, z of the hand falls, and v of the markers falls, towards the hand.",
    )
    gallery = experiments.PictureGallery("First press", tuple(pictures))
    section = experiments.ReportSection("Contradictions", findings or ("None.",), (gallery,))
    report = experiments.Report(f"{name} as the mapping reads it", about, (section,), "")
    return experiments.report_page(report)


def _labels(args: argparse.Namespace, dataset: Dataset, screen: VerbOutput) -> int:
    if args.source.is_dir():
        exchange.read_manifest(args.source)
    read = exchange.read_coco if args.format == "coco" else exchange.read_csv
    rows = read(args.source, dataset)
    done = exchange.import_labels(dataset, rows, args.person, args.source.name, check=args.check)
    would = "would change" if args.check else "changed"
    screen.say(f"Labels that {would}: {done.changed}, that are the same: {done.unchanged}.")
    for uuid, why in done.refused:
        screen.say(f"  {uuid}: {why}")
    for warning in done.warnings:
        screen.say(f"  {warning}")
    backup = _backup_text(done.backup, screen)
    screen.result({
        "changed": done.changed,
        "unchanged": done.unchanged,
        "refused": [{"episode": uuid, "why": why} for uuid, why in done.refused],
        "warnings": list(done.warnings),
        "backup": backup,
    })  # fmt: skip
    return 1 if done.refused else 0


def _backup_text(backup: Path | None, screen: VerbOutput) -> str:
    """Return a sentence with the path of the catalogue backup; "" without one."""
    if backup is None:
        return ""
    screen.say(f"The previous catalogue is in {backup}.")
    return str(backup)
