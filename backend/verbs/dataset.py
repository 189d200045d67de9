"""``touchdown dataset``: what a dataset holds, and how it is looked after."""

from __future__ import annotations

import argparse
import getpass
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from backend.core.faults import InputError
from backend.runs.store import dataset_folder
from backend.verbs import dataset_care
from backend.verbs.screen import Screen

NAME = "dataset"
HELP = "show, check, back up, rebuild and merge datasets"
JSON_VERSION = 1


def status(args: argparse.Namespace, folder: Path, screen: Screen) -> int:
    """Count the episodes by pair and label state."""
    from backend.catalogue.campaigns import list_campaigns
    from backend.catalogue.dataset import Dataset
    from backend.catalogue.values import EpisodeFilter

    with Dataset.open(folder, create=False, write=False) as dataset:
        entries = dataset.episodes(EpisodeFilter(deleted=None))
        age, campaigns = dataset.backups.age, list_campaigns(dataset.database)
    pairs = Counter((e.piece, e.bottom, "deleted" if e.deleted else e.state) for e in entries)
    files = Counter(e.file_state for e in entries)
    states = sorted({state for _, _, state in pairs})
    table = Table(title=f"{len(entries)} episodes in {folder}")
    for column in ("piece", "bottom", *states):
        table.add_column(column, justify="right" if column in states else "left")
    for piece, bottom in sorted({(piece, bottom) for piece, bottom, _ in pairs}):
        counts = (str(pairs[piece, bottom, state] or "-") for state in states)
        table.add_row(piece, bottom, *counts)
    screen.show(table)
    conflicts = sum(e.conflict for e in entries)
    if conflicts:
        screen.say(f"{conflicts} episodes have two labels since a merge: resolve them.")
    for state, count in sorted(files.items()):
        if state != "complete":
            screen.say(f"{count} files are {state}.")
    for one in campaigns:
        screen.say(f"Campaign {one.uuid}: {one.done} items of {one.piece} over {one.bottom} done.")
    hours = None if age is None else round(age.total_seconds() / 3600, 1)
    screen.say("There is no backup." if hours is None else f"Newest backup: {hours} h old.")
    listed = [
        {"piece": piece, "bottom": bottom, "state": state, "episodes": count}
        for (piece, bottom, state), count in sorted(pairs.items())
    ]
    answer = {"version": JSON_VERSION, "dataset": str(folder), "episodes": len(entries)}
    screen.result({**answer, "pairs": listed, "files": dict(files), "conflicts": conflicts,
                   "campaigns": [asdict(one) for one in campaigns],
                   "backup_age_h": hours})  # fmt: skip
    return 0


def merge(args: argparse.Namespace, folder: Path, screen: Screen) -> int:
    """Bring in labels and episodes of another copy of the dataset."""
    from backend.catalogue.dataset import Dataset

    if args.other is None:
        raise InputError("Which copy?", "merge", "Name the folder of another copy of the dataset.")
    person = args.person or getpass.getuser()
    with Dataset.open(folder, create=False, person=person) as dataset:
        notices = dataset.notices
        done = dataset.merge(person, args.other)
    for notice in notices:
        screen.say(notice)
    screen.say(f"{done.operations} label operations and {done.episodes} episodes are new here.")
    if done.conflicts:
        screen.say(f"{len(done.conflicts)} episodes have two labels: resolve them in the window.")
    answer = {"version": JSON_VERSION, "dataset": str(folder), "merged": str(args.other)}
    counts = {"operations": done.operations, "episodes": done.episodes}
    screen.result({**answer, **counts, "conflicts": list(done.conflicts)})
    return 0


Act = Callable[[argparse.Namespace, Path, Screen], int]
ACTIONS: dict[str, Act] = {
    "status": status,
    "verify": dataset_care.verify,
    "backup": dataset_care.backup,
    "restore": dataset_care.restore,
    "rebuild": dataset_care.rebuild,
    "merge": merge,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    lines = "; ".join(f"{name}: {(act.__doc__ or '')[:-1]}" for name, act in ACTIONS.items())
    parser.add_argument("action", nargs="?", choices=ACTIONS, default="status", help=lines)
    parser.add_argument(
        "other", nargs="?", type=Path, help="the backup to restore, or the copy to merge"
    )
    parser.add_argument("--dataset", metavar="DIR", help="dataset (default: in the data folder)")
    parser.add_argument("--person", help="who merges (default: the account's name)")
    parser.add_argument(
        "--replace", action="store_true", help="rebuild: put the new catalogue in its place"
    )


def run(args: argparse.Namespace, screen: Screen) -> int:
    """Do one action; returns its exit code."""
    if args.other is not None and args.action not in ("restore", "merge"):
        raise InputError(
            f"'{args.action}' takes no file.", str(args.other), "Name the dataset by --dataset."
        )
    folder = Path(args.dataset) if args.dataset else dataset_folder()
    return ACTIONS[args.action](args, folder, screen)
