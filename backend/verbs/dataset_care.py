"""Looking after a dataset: verify, back up, go back to a backup, make the catalogue anew."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from backend.core.faults import InputError
from backend.verbs.screen import Screen

if TYPE_CHECKING:
    from backend.catalogue.findings import Finding

# What a catalogue needs is imported where it is used, so that `touchdown --help` starts quickly.


def examine_only(folder: Path, screen: Screen) -> int:
    """Report what is out of order, changing nothing; 1 if anything is."""
    from backend.catalogue.backups import list_backups
    from backend.catalogue.dataset import Dataset
    from backend.catalogue.recovery import examine

    with Dataset.open(folder, create=False, write=False) as dataset:
        found = list(examine(dataset.store, whole=True))
    copies = list_backups(folder / "backup")
    newest = copies[0].made.isoformat(timespec="seconds") if copies else None
    screen.say(f"{folder}, newest backup: {newest or 'none'}")
    return _report(found, screen, {"dataset": str(folder), "newest_backup": newest})


def verify(args: argparse.Namespace, folder: Path, screen: Screen) -> int:
    """Read every file, check every label operation, and note what is damaged; 1 if anything is."""
    from backend.catalogue.dataset import Dataset
    from backend.catalogue.recovery import examine, reconcile
    from backend.catalogue.writer_lock import NotWritableError

    try:
        with Dataset.open(folder, create=False) as dataset:
            for notice in dataset.notices:
                screen.say(notice)
            found, count = reconcile(dataset.store, whole=True), len(dataset.episodes())
    except NotWritableError as error:
        with Dataset.open(folder, create=False, write=False) as dataset:
            found, count = list(examine(dataset.store, whole=True)), len(dataset.episodes())
        screen.say(f"{error.what} It is looked at only; nothing is noted there.")
        return _report(found, screen, {"dataset": str(folder), "episodes": count, "noted": False})
    screen.say(f"{count} episodes read.")
    return _report(found, screen, {"dataset": str(folder), "episodes": count, "noted": True})


def backup(args: argparse.Namespace, folder: Path, screen: Screen) -> int:
    """Make a verified copy of the catalogue now."""
    from backend.catalogue.dataset import Dataset

    with Dataset.open(folder, create=False) as dataset:
        path = dataset.backups.make("by hand")
    screen.say(f"{path} ({path.stat().st_size / 1e6:.1f} MB), opened and checked.")
    screen.result({"dataset": str(folder), "backup": str(path), "bytes": path.stat().st_size})
    return 0


def restore(args: argparse.Namespace, folder: Path, screen: Screen) -> int:
    """Go back to a copy of the catalogue; later labels come back from the journal."""
    from backend.catalogue import backups
    from backend.catalogue.dataset import Dataset
    from backend.catalogue.writer_lock import WriterLock

    if args.other is None:
        raise InputError(
            "Which backup?", "restore", f"Name a file, such as one in {folder / 'backup'}."
        )
    lock = WriterLock.take(folder)
    try:
        aside = backups.restore(folder, args.other)
    finally:
        lock.release()
    with Dataset.open(folder, create=False) as dataset:
        notices = dataset.notices
    for line in (*notices, f"Restored from {args.other}; the former catalogue: {aside}."):
        screen.say(line)
    answer = {"dataset": str(folder), "restored": str(args.other), "former": str(aside)}
    screen.result({**answer, "notices": list(notices)})
    return 0


def rebuild(args: argparse.Namespace, folder: Path, screen: Screen) -> int:
    """Make the catalogue anew from files, packs and journal; 1 if it differs from the old one."""
    from backend.catalogue.rebuilding import rebuild as make_anew

    result = make_anew(folder, replace=args.replace)
    table = Table(title="catalogue made anew")
    for column in ("table", "rows", "only in the old", "only in the new"):
        table.add_column(column, justify="left" if column == "table" else "right")
    for name, rows in result.rows.items():
        only = (result.only_old.get(name, "-"), result.only_new.get(name, "-"))
        table.add_row(name, str(rows), *map(str, only))
    screen.show(table)
    for notice in result.notices:
        screen.say(notice)
    if not result.old_readable:
        screen.say("The old catalogue could not be read: nothing to compare with.")
    else:
        screen.say("Both say the same." if result.equal else "They differ.")
    if result.replaced:
        screen.say("The new one is in its place; the old one is in quarantine.")
    screen.result(
        {
            "dataset": str(folder), "rows": result.rows, "only_old": result.only_old,
            "only_new": result.only_new, "equal": result.equal, "replaced": result.replaced,
            "notices": list(result.notices),
        }
    )  # fmt: skip
    return 0 if result.equal or (result.replaced and not result.old_readable) else 1


def _report(found: Sequence[Finding], screen: Screen, facts: dict[str, object]) -> int:
    table = Table(title="out of order")
    for column in ("what", "where", "found"):
        table.add_column(column, overflow="fold")
    for finding in found:
        table.add_row(finding.kind.replace("-", " "), finding.target, finding.said)
    if found:
        screen.show(table)
    screen.say(f"{len(found)} findings." if found else "Files, labels and journal agree.")
    listed = [{"kind": f.kind, "target": f.target, "said": f.said} for f in found]
    screen.result({**facts, "findings": listed})
    return 1 if found else 0
