"""``touchdown stack``: run the stacking loop on a bench and print its events."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from rich.table import Table

from touchdown.backend import core
from touchdown.backend.cli import connection, output
from touchdown.backend.cli.settings import load_method
from touchdown.backend.runs import (
    DecisionMode,
    RecordingOptions,
    StackRequest,
    StrategyChoice,
    certificate_status,
)

if TYPE_CHECKING:
    from touchdown.backend.bench import RunResult, Session


BOTTOM = "short"
COLUMNS = ("outcome", "probes", "excess", "margin mm", "reason")
EACH_STEPS = 5  # steps of a phase between two lines
INPUT_CODE = "INPUT"  # code of bad input, which the command line reports itself


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    connection.add_scene_arguments(
        parser, BOTTOM, "support, bottom-up and joined by + for a tower, such as short+long"
    )
    add = parser.add_argument
    add("--seed", type=int, default=0, help="trial k uses seed + k")
    add("--trials", type=int, default=1)
    add("--strategy", choices=get_args(StrategyChoice), default="paper")
    known = "checkpoint (default: the one in use); the networks of fused decide without it"
    add("--model", metavar="FILE", help=known)
    add("--method", type=Path, metavar="FILE", help="settings of the method (see 'settings')")
    add("--mode", choices=("auto", "approve", "step"),
        help="ask before a move (default: auto when simulated, approve on devices)")  # fmt: skip
    add("--origin", type=float, nargs=2, default=(0.0, 0.0), metavar=("X", "Y"),
        help="on devices: centre of the bottom in the frame of the arm, mm (default: "
        "0 0)")  # fmt: skip
    add("--reset-guard", metavar="REASON", help="of fused: restart the comparison of the signals")
    add("--weigh", action="store_true", help="weigh the piece in six poses first, and judge by its "
        "measured centre of mass")  # fmt: skip
    add("--staged", action="store_true",
        help="open the jaws in held steps, and close them if the piece begins to turn")  # fmt: skip
    connection.add_bench_arguments(parser)
    add("--live", nargs="?", const="127.0.0.1:8765", metavar="HOST:PORT",
        help="serve streams and events to Foxglove (127.0.0.1:8765)")  # fmt: skip
    add("--runs", metavar="DIR", help="folder for runs (default: data folder)")
    add("--no-episodes", action="store_true", help="store the journal only")


def run(args: argparse.Namespace, screen: output.VerbOutput) -> int:
    """Run all trials; return 0 if every piece was placed, else 1."""
    lab = connection.at_lab(args)
    connection.refuse_misplaced_arguments(args)
    if not lab and any(args.origin):
        fix = "Name a lab file with --bench."
        raise core.InputError("This argument is for real devices only.", "--origin", fix)
    connection.fill_in_scene(args, BOTTOM)
    mode: DecisionMode = args.mode or ("approve" if lab else "auto")
    if mode != "auto" and screen.json:
        fix = "Leave out --json."
        raise core.InputError("With --json the moves to approve are not shown.", "--mode", fix)
    if lab and screen.json:
        raise core.InputError("Trials on devices ask their operator.", "--json", "Leave it out.")
    request = StackRequest(
        piece=args.piece,
        bottoms=tuple(args.bottom.split("+")),
        seed=args.seed,
        trials=args.trials,
        strategy=args.strategy,
        mode=mode,
        model=args.model,
        origin_mm=(args.origin[0], args.origin[1]),
        weigh=args.weigh,
        staged=args.staged,
    )
    runs = Path(args.runs) if args.runs else core.data_folder() / "runs"
    keep = RecordingOptions(runs, episodes=not args.no_episodes)
    method = load_method(args.method) if args.method else None
    with connection.open_bench(
        args, screen, keep, method=method, prepare=lambda _: request, campaign=True
    ) as session:
        bench = session.name or f"{'emulated' if args.emulated else 'simulated'} bench"

        def take(fact: core.Event) -> None:
            narrate(fact, screen, bench)
            if isinstance(fact, core.ApprovalAwaited):
                action = fact.action
                step = ", ".join(f"{value:+.1f} mm" for value in action.step_mm)
                text = action.reason if action.kind == "ask" else f"{action.kind} ({step})?"
                screen.say(f"  {text} Enter or y: yes; anything else: no.")
                number = session.prompt.number
                connection.ask_yes_no_in_thread(lambda yes: session.prompt.answer(yes, number))
            connection.answer_prompt(fact, session, screen)

        session.events.subscribe(take)
        if args.live:
            from touchdown.backend.bench import serve_live

            screen.say(serve_live(session, args.live))
        session.prompt.attended = sys.stdin.isatty() and not screen.json
        if args.reset_guard is not None:
            guard = session.guard_of(request.method(session.method))
            if guard is None:
                fix = "Leave it out, or name the strategy and bench of a calibrated network."
                raise core.InputError("No signals are compared in this run.", "--reset-guard", fix)
            guard.reset(args.reset_guard)
        with (
            screen.ctrl_c_cancels(session.engine.cancel),
            connection.held_piece_reported(session, screen),
        ):
            result = session.run(request)
    if result.trials:
        screen.show(trial_table(result.trials, bench=bench.removesuffix(" bench"), lab=screen.lab))
    else:
        screen.say(f"No trial took place: {result.reason}")
    if result.run_folder is not None:
        screen.say(f"Kept in {result.run_folder}")
    screen.result({**_result(request, result, session), "bench": bench})
    placed = [t for t in result.trials if t.outcome is core.Outcome.PLACED]
    return 0 if len(placed) == request.trials and not result.faults else 1


def narrate(fact: core.Event, screen: output.VerbOutput, bench: str = "simulated bench") -> None:
    """Print an event for people, if it has a text."""
    if isinstance(fact, core.TrialStarted):
        screen.say(f"Trial {fact.trial}, seed {fact.seed} ({bench})")
    elif isinstance(fact, core.Said | core.Noticed):
        screen.say(f"  {fact.t_s:6.2f} s  {fact.text}")
    elif isinstance(fact, core.PhaseEntered) and fact.phase in ("unload", "release"):
        screen.say(f"  {fact.t_s:6.2f} s  {fact.phase}")
    elif isinstance(fact, core.Progress) and fact.done % EACH_STEPS == 0:
        steps = f"step {fact.done} of {fact.total}"
        screen.say(f"  {fact.t_s:6.2f} s  {fact.text}, {steps}")
    elif isinstance(fact, core.FaultRaised) and fact.fault.code != INPUT_CODE:
        fault = fact.fault
        screen.say(
            f"  {fact.t_s:6.2f} s  FAULT {fault.code}: {fault.what} {fault.consequence} "
            f"{fault.next_step}"
        )
    elif isinstance(fact, core.TrialFinished):
        word = fact.outcome.value.replace("_", " ")
        screen.say(f"  {fact.t_s:6.2f} s  {word}: {fact.reason}")


def trial_table(
    trials: Sequence[core.TrialFinished],
    pieces: Sequence[str] = (),
    bench: str = "simulated",
    lab: str = "",
) -> Table:
    """Return the result table of a run; ``pieces``: a first column, one per trial."""
    placed = sum(t.outcome is core.Outcome.PLACED for t in trials)
    rows = []
    for index, t in enumerate(trials):
        margin = "" if t.margin_mm is None else f"{t.margin_mm:+.2f}"
        excess = "" if t.excess_probes is None else str(t.excess_probes)
        first = (*pieces[index : index + 1], str(t.seed))
        rows.append((*first, t.outcome.value, str(t.probes), excess, margin, t.reason))
    header = (*(("piece",) if pieces else ()), "seed", *COLUMNS)
    return output.text_table(f"{placed} of {len(trials)} placed ({bench})", header, *rows, lab=lab)


def _result(request: StackRequest, result: RunResult, session: Session) -> dict[str, object]:
    return {
        "piece": request.piece,
        "bottom": "+".join(request.bottoms),
        "strategy": request.strategy,
        "simulated": session.simulated,
        "run": None if result.run_folder is None else str(result.run_folder),
        "certificate": certificate_status(session.identity, session.method, request).text,
        "faults": [fault.code for fault in result.faults],
        "trials": [
            {key: value for key, value in asdict(t).items() if key not in ("t_s", "trial")}
            | {"outcome": t.outcome.value, "reason": output.without_window(t.reason)}
            for t in result.trials
        ],
    }
