"""``touchdown export``: write episodes and labels in the format of another program."""

from __future__ import annotations

import argparse
from typing import cast

from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.exchange import EXPORTS, ExportState, export
from touchdown.backend.runs import dataset_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("format", choices=EXPORTS, help="what to write")
    add("--dataset", metavar="DIR", help="dataset (default: in the data folder)")
    add("--out", metavar="DIR", required=True, help="new folder to write")
    for name in ("piece", "bottom", "series", "campaign"):
        add(f"--{name}", help=f"only this {name}")
    add("--states", default="approved", metavar="S,S",
        help="label states: approved, submitted, draft")  # fmt: skip
    add("--video", choices=("sample", "all", "none"), help="pictures of 20 episodes, all or none "
        "(default: sample for lerobot, else none)")  # fmt: skip
    add("--held-out", type=float, default=0.2, metavar="SHARE",
        help="held-out share, in whole series or mountings")  # fmt: skip
    add("--state-with", default="", metavar="S,S",
        help="lerobot: wrench, markers or both in observation.state besides the pose; followed by "
        "environment_state in that feature instead")  # fmt: skip
    add("--seed", type=int, default=0, help="which series are held out")
    add("--divide-series", action="store_true",
        help="split a pair with a single series by grips; noted in the manifest")  # fmt: skip


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Export; return 0 if the folder is complete."""
    with screen.progress(f"Exporting to {args.format}", None) as advance:
        done = export(
            args.dataset or dataset_folder(),
            args.format,
            args.out,
            piece=args.piece,
            bottom=args.bottom,
            series=args.series,
            campaign=args.campaign,
            states=cast("tuple[ExportState, ...]", tuple(args.states.replace(" ", "").split(","))),
            held_out=args.held_out,
            seed=args.seed,
            divide_series=args.divide_series,
            video=args.video,
            state_with=tuple(args.state_with.split(",")) if args.state_with else (),
            on_progress=lambda count, total: advance(count, total=total),
        )
    screen.say(f"Episodes in {done.folder}: {done.episodes}.")
    for warning in done.warnings:
        screen.say(f"  {warning}")
    screen.result({
        "format": args.format,
        "out": str(done.folder),
        "episodes": done.episodes,
        "manifest_sha256": done.manifest_sha256,
        "warnings": list(done.warnings),
    })  # fmt: skip
    return 0
