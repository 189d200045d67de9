"""``touchdown collect``: fill a dataset with labelled probes of a bench."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

from touchdown.backend import core
from touchdown.backend.annotations import Dataset, EpisodeFilter
from touchdown.backend.bench import Session
from touchdown.backend.cli import connection
from touchdown.backend.cli.dataset import dataset_to_fill
from touchdown.backend.cli.output import VerbOutput, person_of
from touchdown.backend.config import CollectSettings, RecordingPlan, StackSettings
from touchdown.backend.episodes import Coverage, check_quality
from touchdown.backend.runs import (
    PRESS_OF_PLAN,
    CollectRequest,
    RecordingOptions,
    current_campaign,
    dataset_folder,
    fresh_seed,
    labelled_coverage,
    newest_campaign,
    read_campaign,
    read_examined_episodes,
    read_plan,
)

BOTTOM = "circle15"
MAX_LISTED = 12  # printed findings; ``--json`` contains all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    connection.add_scene_arguments(parser, BOTTOM, "bottom piece")
    add = parser.add_argument
    add("--count", type=int, help="probes to collect (default: 20)")
    add("--plan", metavar="PLAN", help="for identify: rest, gel, contact, drag, or a TOML file")
    add("--pattern", choices=("random", "grid", "adaptive"), help="(default: random)")
    add("--within", type=float, dest="within_mm", metavar="MM", help="largest displacement in x, y")
    add("--seed", type=int, help="of the displacements (default: a new one)")
    limits = CollectSettings()
    add(
        "--probes-per-grip", type=int,
        help=f"maximum (default: a third of the campaign, at most {limits.probes_per_grip})",
    )  # fmt: skip
    add(
        "--grips-per-mounting", type=int,
        help=f"maximum (default: a third of the grips, at most {limits.grips_per_mounting})",
    )  # fmt: skip
    connection.add_hand_over_arguments(parser)
    add("--origin-sigma", type=float, metavar="MM", help="standard uncertainty of the origin")
    add("--check-origin", action="store_true", help="probe the four edges after every mounting")
    add("--dataset", metavar="DIR", help="dataset (default: in the data folder)")
    add("--person", help="who collects (default: the account's name)")
    add("--resume", nargs="?", const="newest", metavar="CAMPAIGN",
        help="resume the newest campaign, or the named one, with its plan")  # fmt: skip
    connection.add_bench_arguments(parser)
    add("--runs", metavar="DIR", help="folder for journals (default: data folder)")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Collect; return 0 if every probe of the plan was recorded or skipped on purpose, else 1."""
    connection.refuse_misplaced_arguments(args)
    # A real bench has no jig: the operator hands the piece over.
    args.hand_over |= connection.at_lab(args)
    connection.refuse_hidden_prompt(args, screen)
    folder = Path(args.dataset) if args.dataset else dataset_folder()
    runs = Path(args.runs) if args.runs else core.data_folder() / "runs"
    keep = RecordingOptions(runs, episodes=False)
    person = person_of(args)
    with dataset_to_fill(folder, person, screen, create=args.resume is None) as dataset:
        request = _request(args, dataset, person)
        if request.campaign:
            screen.say(f"Resuming the campaign with its {request.piece} on {request.bottom}.")

        def prepare(session: Session) -> CollectRequest:
            session.dataset = dataset
            return request

        with connection.open_bench(
            args, screen, keep, method=StackSettings(), prepare=prepare, campaign=True
        ) as session:
            prepare(session)
            # The bar starts with the campaign, after the arguments are checked.
            with (
                ExitStack() as bars,
                screen.ctrl_c_cancels(session.engine.cancel),
                connection.held_piece_reported(session, screen),
            ):
                told = _CollectionProgress("Collecting", screen, bars, session)
                session.events.subscribe(told.take)
                session.run(request)
        return _report(dataset, session, told, screen)


class _CollectionProgress(connection.RunProgress):
    """Events of a campaign so far."""

    began: core.CampaignBegan | None = None

    def take(self, fact: core.Event) -> None:
        super().take(fact)
        if isinstance(fact, core.CampaignBegan | core.ProbeCollected):
            self.move(fact.done, fact.total, f"of {fact.total}")
        if isinstance(fact, core.CampaignBegan):
            self.began = fact
        elif isinstance(fact, core.ProbeCollected):
            if fact.reasons:
                self.screen.say(f"  probe {fact.probe} is not an observation: {fact.reasons}")
        elif isinstance(fact, core.Gripped):
            at = f"mounting {fact.mounting}, grip {fact.grip}"
            self.screen.say(f"  {at}: {fact.mass_g:.1f} g held")
        elif isinstance(fact, core.Paused):
            if connection.wait_for_disk_space(fact.fault, self.screen, "campaign"):
                self.session.engine.resume()
            else:
                # Without an operator the campaign ends and can be resumed.
                self.faults.append(fact.fault.code)
                self.session.engine.cancel()


def _plan(args: argparse.Namespace) -> RecordingPlan | None:
    """Return the recording plan; other arguments override its numbers of probes and grips."""
    if args.plan is None:
        args.count = 20 if args.count is None else args.count
        return None
    plan = read_plan(args.plan)
    for name in ("count", "within_mm", "probes_per_grip", "grips_per_mounting"):
        if getattr(args, name) is None:
            setattr(args, name, getattr(plan, name))
    return plan


def _campaign(args: argparse.Namespace, folder: Path) -> str:
    """Return the campaign to resume, or ""; raises ``InputError`` if arguments contradict it."""
    if args.resume is None:
        return ""
    uuid = newest_campaign(folder) if args.resume == "newest" else args.resume
    if uuid is None:
        what, fix = "This dataset has no campaign.", "Collect without --resume."
        raise core.InputError(what, str(folder), fix)
    campaign = read_campaign(folder, uuid)
    for name in ("piece", "bottom", "count", "pattern", "seed", "within_mm"):
        given, stored = getattr(args, name), getattr(campaign, name)
        if given not in (None, stored):
            flag = f"--{name.removesuffix('_mm')}"
            begun = f"no {flag}" if stored is None else f"{flag} {stored}"
            fix = "Leave it out, or begin another campaign without --resume."
            raise core.InputError(f"The campaign was begun with {begun}, not {given}.", flag, fix)
    args.piece, args.bottom = campaign.piece, campaign.bottom  # not those of a lab file
    return uuid


def _request(args: argparse.Namespace, dataset: Dataset, person: str) -> CollectRequest:
    campaign = _campaign(args, dataset.folder)
    connection.fill_in_scene(args, BOTTOM)
    plan = _plan(args)
    return CollectRequest(
        **({} if plan is None else plan.model_dump(include=PRESS_OF_PLAN)),
        piece=args.piece,
        bottom=args.bottom,
        count=args.count,
        seed=fresh_seed() if args.seed is None else args.seed,
        pattern=args.pattern or "random",
        person=person,
        within_mm=args.within_mm,
        origin_mm=(args.origin[0], args.origin[1]),
        origin_sigma_mm=args.origin_sigma,
        check_origin=args.check_origin,
        campaign=campaign,
        probes_per_grip=args.probes_per_grip,
        grips_per_mounting=args.grips_per_mounting,
        hand_over=args.hand_over,
    )


def _report(
    dataset: Dataset, session: Session, told: _CollectionProgress, screen: VerbOutput
) -> int:
    assert told.began is not None
    assert told.ended is not None
    campaign = current_campaign(dataset, told.began.campaign)
    entries = dataset.episodes(EpisodeFilter(campaign=campaign.uuid))
    piece, bottom = (session.catalogue.piece(n) for n in (campaign.piece, campaign.bottom))
    seen = labelled_coverage(dataset, entries, piece.face, bottom.face)
    findings = check_quality(read_examined_episodes(dataset, entries))
    left = len(campaign.todo(entries))
    done = campaign.count - left - len(campaign.skipped)
    screen.say(told.ended.reason)
    more = f"; --resume continues with the other {left}." if left else "."
    screen.say(f"{done} of {campaign.count} probes are done{more}")
    if campaign.recording.get("stage") == "contact":
        screen.say(f"Presses kept for identify, which needs them to slip: {len(entries)}.")
    screen.say(coverage_text(seen))
    screen.say(f"Health: {len(findings) or 'no'} findings.")
    for finding in findings[:MAX_LISTED]:
        screen.say(f"  {finding.kind}: {finding.text} {' '.join(finding.episodes)}".rstrip())
    if len(findings) > MAX_LISTED:
        screen.say(f"  ... and {len(findings) - MAX_LISTED} more (--json lists all)")
    screen.say(f"Dataset {dataset.folder}, campaign {campaign.uuid}, seed {campaign.seed}")
    screen.result({
        "dataset": str(dataset.folder),
        "campaign": campaign.uuid, "seed": campaign.seed,
        "piece": campaign.piece,
        "bottom": campaign.bottom,
        "simulated": session.simulated,
        "ending": told.ended.ending,
        "collected": done,
        "count": campaign.count,
        "left_out": list(campaign.skipped),
        "covered": seen.covered,
        "holes": seen.holes,
        "findings": [
            {"kind": f.kind, "episodes": list(f.episodes), "text": f.text} for f in findings
        ],
        "faults": told.faults,
        "run": None if session.run_folder is None else str(session.run_folder),
    })  # fmt: skip
    return 0 if not left else 1


def coverage_text(seen: Coverage) -> str:
    """Return the counts per bin as text, y up; a dot is an empty bin."""
    possible = int(seen.possible.sum())
    lines = [f"Covered {possible - seen.holes} of {possible} bins of {seen.bin_mm:g} mm:"]
    for row in range(len(seen.counts) - 1, -1, -1):
        marks = [
            ("." if possible else " ") if count == 0 else str(count) if count < 10 else "+"
            for count, possible in zip(seen.counts[row], seen.possible[row], strict=True)
        ]
        lines.append(("  " + " ".join(marks)).rstrip())
    return "\n".join(line for line in lines if line.strip())
