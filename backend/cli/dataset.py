"""``touchdown dataset``: status, verification, backup, rebuild and merge of datasets."""

from __future__ import annotations

import argparse
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from touchdown.backend.annotations import (
    ConsistencyProblem,
    Dataset,
    EpisodeFilter,
    NotWritableError,
    list_backups,
    list_campaigns,
    rebuild_dataset,
    restore_backup,
)
from touchdown.backend.cli.output import VerbOutput, person_of, progress_lines
from touchdown.backend.core import InputError
from touchdown.backend.runs import dataset_folder, newest_campaign


@contextmanager
def dataset_to_fill(
    folder: Path, person: str, screen: VerbOutput, *, create: bool
) -> Iterator[Dataset]:
    """Open a dataset or make it; a new one in which nothing is stored is removed at the end."""
    removed = False
    try:
        is_new, progress = not folder.exists(), progress_lines()
        with Dataset.open(folder, create=create, person=person, progress=progress) as dataset:
            for notice in dataset.notices:
                screen.say(notice)
            try:
                yield dataset
            finally:
                stored = newest_campaign(folder) or dataset.episodes(
                    EpisodeFilter(deleted=None, limit=1)
                )
                removed = is_new and not stored
    finally:
        if removed:
            shutil.rmtree(folder)


def examine_only(folder: Path, screen: VerbOutput) -> int:
    """Report findings without changes; return 1 if there are any."""
    with Dataset.open(folder, create=False, write=False) as dataset:
        found = dataset.verify(progress_lines())
    copies = list_backups(folder / "backup")
    newest = copies[0].made.isoformat(timespec="seconds") if copies else None
    screen.say(f"{folder}, newest backup: {newest or 'none'}")
    return _report(found, screen, {"dataset": str(folder), "newest_backup": newest})


def verify(args: argparse.Namespace, folder: Path, screen: VerbOutput) -> int:
    """Read every file, check every label operation, and record damage; return 1 if there is any."""
    progress = progress_lines()
    try:
        dataset = Dataset.open(folder, create=False, progress=progress)
    except NotWritableError as error:
        if args.resolve:
            raise
        dataset = Dataset.open(folder, create=False, write=False)
        screen.say(f"{error.what} It is only read; nothing is recorded there.")
    with dataset:
        for notice in dataset.notices:
            screen.say(notice)
        found, noted = dataset.verify(progress), dataset.writable
        resolved = dataset.resolve(person_of(args)) if args.resolve else []
        closed = [f"{one.kind} {one.target}" for one in resolved]
        found = [one for one in found if f"{one.kind} {one.target}" not in closed]
        count = sum(one.episodes for one in dataset.count_by_pair() if one.state != "deleted")
    screen.say(f"Episodes read: {count}.")
    for name in closed:
        screen.say(f"Resolved: {name}.")
    facts: dict[str, object] = {"dataset": str(folder), "episodes": count, "noted": noted}
    if args.resolve:
        facts["resolved"] = closed
    return _report(found, screen, facts)


def backup(args: argparse.Namespace, folder: Path, screen: VerbOutput) -> int:
    """Make a verified copy of the catalogue now."""
    with Dataset.open(folder, create=False, progress=progress_lines()) as dataset:
        path = dataset.backups.make("by hand")
    screen.say(f"{path} ({path.stat().st_size / 1e6:.1f} MB), opened and checked.")
    screen.result({"dataset": str(folder), "backup": str(path), "bytes": path.stat().st_size})
    return 0


def restore(args: argparse.Namespace, folder: Path, screen: VerbOutput) -> int:
    """Restore a backup; later labels are read back from the journal."""
    lost = not any((folder / "labels").glob("*.jsonl"))
    aside = restore_backup(folder, args.other)
    with Dataset.open(folder, progress=progress_lines()) as dataset:
        notices = list(dataset.notices)
        dataset.resolve(person_of(args), "replay")
    if lost:
        notices.append("There were no labels here: the dataset now has those of the backup.")
    for line in (*notices, f"Restored from {args.other}; the previous catalogue: {aside}."):
        screen.say(line)
    answer = {"dataset": str(folder), "restored": str(args.other)}
    screen.result({**answer, "former": aside and str(aside), "notices": notices})
    return 0


def rebuild(args: argparse.Namespace, folder: Path, screen: VerbOutput) -> int:
    """Rebuild the catalogue from files, packs and journal; return 1 if it differs."""
    result = rebuild_dataset(folder, replace=args.replace)
    columns = ("rows", "only in the old", "only in the new")
    sides = (result.only_old, result.only_new)
    counts = [
        (name, str(rows), *(str(only.get(name, "-")) for only in sides))
        for name, rows in result.rows.items()
    ]
    screen.table("catalogue rebuilt", ("table", *columns), *counts, right=columns)
    for notice in result.notices:
        screen.say(notice)
    if not result.old_readable:
        screen.say("The old catalogue could not be read for a comparison.")
    else:
        screen.say("Both are equal." if result.equal else "They differ.")
    if result.replaced:
        screen.say("The new catalogue is in use; the old one is in quarantine.")
    screen.result({
        "dataset": str(folder), "rows": result.rows, "only_old": result.only_old,
        "only_new": result.only_new, "equal": result.equal, "replaced": result.replaced,
        "notices": list(result.notices),
    })  # fmt: skip
    return 0 if result.equal or (result.replaced and not result.old_readable) else 1


def _report(
    found: Sequence[ConsistencyProblem], screen: VerbOutput, facts: dict[str, object]
) -> int:
    if found:
        rows = ((f.kind.replace("-", " "), f.target, f.message) for f in found)
        screen.table("out of order", ("what", "where", "found"), *rows)
    screen.say(f"{len(found)} findings." if found else "Files, labels and journal agree.")
    listed = [{"kind": f.kind, "target": f.target, "said": f.message} for f in found]
    screen.result({**facts, "findings": listed})
    return 1 if found else 0


def status(args: argparse.Namespace, folder: Path, screen: VerbOutput) -> int:
    """Count the episodes by pair and label state."""
    pairs, files, conflicts = Counter[tuple[str, str, str]](), Counter[str](), 0
    with Dataset.open(folder, create=False, write=False) as dataset:
        counts = dataset.count_by_pair()
        age, campaigns = dataset.backups.age, list_campaigns(dataset.database)
        if by := dataset.newer_writer:
            screen.say(f"It was written by {by}.")
    for one in counts:
        pairs[one.piece, one.bottom, one.state] += one.episodes
        files[one.file_state] += one.episodes
        conflicts += one.conflicts
    states = sorted({state for _, _, state in pairs})
    rows = [
        (piece, bottom, *(str(pairs[piece, bottom, state] or "-") for state in states))
        for piece, bottom in sorted({(piece, bottom) for piece, bottom, _ in pairs})
    ]
    title = f"Episodes in {folder}: {pairs.total()}"
    screen.table(title, ("piece", "bottom", *states), *rows, right=states)
    if conflicts:
        screen.say(f"Episodes with two labels since a merge: {conflicts}. Resolve them.")
    for state, count in sorted(files.items()):
        if state != "complete":
            screen.say(f"Files that are {state}: {count}.")
    for run in campaigns:
        screen.say(f"Campaign {run.uuid}: {run.done} items of {run.piece} over {run.bottom} done.")
    hours = None if age is None else round(age.total_seconds() / 3600, 1)
    screen.say("There is no backup." if hours is None else f"Newest backup: {hours} h old.")
    listed = [
        {"piece": piece, "bottom": bottom, "state": state, "episodes": count}
        for (piece, bottom, state), count in sorted(pairs.items())
    ]
    answer = {"dataset": str(folder), "episodes": pairs.total()}
    screen.result({**answer, "pairs": listed, "files": dict(files), "conflicts": conflicts,
                   "campaigns": [asdict(one) for one in campaigns],
                   "backup_age_h": hours, "newer_writer": by or None})  # fmt: skip
    return 0


def merge(args: argparse.Namespace, folder: Path, screen: VerbOutput) -> int:
    """Merge labels and episodes of another copy of the dataset."""
    person = person_of(args)
    with dataset_to_fill(folder, person, screen, create=False) as dataset:
        done = dataset.merge(person, args.other)
    screen.say(f"New here: label operations {done.operations}, episodes {done.episodes}.")
    if done.conflicts:
        screen.say(f"Episodes with two labels: {len(done.conflicts)}. Resolve them in the window.")
    answer = {"dataset": str(folder), "merged": str(args.other)}
    counts = {"operations": done.operations, "episodes": done.episodes}
    screen.result({**answer, **counts, "conflicts": list(done.conflicts)})
    return 0


DatasetAction = Callable[[argparse.Namespace, Path, VerbOutput], int]
ACTIONS: dict[str, DatasetAction] = {
    "status": status,
    "verify": verify,
    "backup": backup,
    "restore": restore,
    "rebuild": rebuild,
    "merge": merge,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    lines = "; ".join(f"{name}: {(act.__doc__ or '')[:-1]}" for name, act in ACTIONS.items())
    add = parser.add_argument
    add("action", nargs="?", choices=ACTIONS, default="status", help=lines)
    add("other", nargs="?", type=Path, help="the backup to restore, or the copy to merge")
    add("--dataset", metavar="DIR", help="dataset (default: in the data folder)")
    add("--person", help="who merges or resolves (default: the account)")
    add("--resolve", action="store_true", help="verify: mark repaired damage as resolved")
    add("--replace", action="store_true", help="rebuild: replace the catalogue")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Run one action; return its exit code."""
    folder = Path(args.dataset) if args.dataset else dataset_folder()
    named = {"restore": f"one in {folder / 'backup'}", "merge": "another copy of the dataset"}
    for option, action in (("resolve", "verify"), ("replace", "rebuild")):
        if getattr(args, option) and args.action != action:
            raise InputError(f"This is for '{action}' only.", f"--{option}", "Leave it out.")
    if args.other is not None and args.action not in named:
        fix = "Name the dataset by --dataset."
        raise InputError(f"'{args.action}' takes no file.", str(args.other), fix)
    if args.other is None and args.action in named:
        what = f"'{args.action}' needs a file or folder."
        raise InputError(what, "touchdown dataset", f"Name {named[args.action]}.")
    return ACTIONS[args.action](args, folder, screen)
