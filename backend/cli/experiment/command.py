"""``touchdown experiment``: the paper's tables, other strategies, learned fusion, reports."""

from __future__ import annotations

import argparse
import re
from dataclasses import replace
from pathlib import Path

from touchdown.backend import core, experiments
from touchdown.backend.annotations import LABEL_CHOICES
from touchdown.backend.cli.experiment import campaign
from touchdown.backend.cli.output import VerbOutput, require_positive
from touchdown.backend.config import SimulationSettings, StackSettings
from touchdown.backend.geometry import FRESH_SEED, load_pieces
from touchdown.backend.runs import check_weighing


def add_report_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``report``."""
    report = parser.add_argument_group("report")
    report.add_argument("--tables", type=Path, metavar="JSON", help="the tables.json whose page is "
                        "written again, beside it (default: that of --out)")  # fmt: skip
    report.add_argument("--beyond", type=Path, nargs="+", default=[], metavar="JSON", help="its "
                        "new comparisons of strategies, each a beyond.json of the same bench "
                        "(default: the present ones)")  # fmt: skip


MOST_NETWORKS = 8


def add_fused_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fused``."""
    fused = parser.add_argument_group("fused")
    fused.add_argument(
        "--parts", type=int, default=100, help="jobs of 240 sequences of five probes"
    )
    fused.add_argument("--long-parts", type=int, default=0, help="of eight probes")
    fused.add_argument("--longest-parts", type=int, default=0, help="of twelve probes")
    fused.add_argument(
        "--free-parts", type=int, default=0, help="of eight probes on bottoms that rock and slide"
    )
    fused.add_argument("--surface-parts", type=int, default=0, help="of eight probes on tilted, "
                       "stepped and domed bottoms; needs --outlines any")  # fmt: skip
    fused.add_argument("--steps", type=int, default=6000, help="of the training; 0: data only")
    fused.add_argument("--batch", type=int, default=128, help="sequences a step; 512 pays on a "
                       "graphics processor")  # fmt: skip
    fused.add_argument("--networks", type=int, default=1, metavar="N", help="to train; "
                       "all must agree on a release")  # fmt: skip
    fused.add_argument("--ready", action="store_true", help="train on the finished sequences of "
                       "--out, also of earlier versions of the program; simulate none")  # fmt: skip
    fused.add_argument("--seed", type=int, default=0, help="of data and training")
    fused.add_argument("--outlines", choices=("convex", "any"), default="convex", help="of the "
                       "bottoms; any: also rings, crescents, L, U, stars and feet")  # fmt: skip
    fused.add_argument("--wrench-alone", action="store_true", help="do not read the markers")
    fused.add_argument("--ranges", type=Path, metavar="JSON", help="figures of 'identify' beside "
                       "its bench file: each job of sequences draws its bench from the 95 %% "
                       "intervals")  # fmt: skip
    fused.add_argument("--from", type=Path, dest="pretrained", metavar="CHECKPOINT", help="network "
                       "of 'fused' to fine-tune on the simulated parts and on --data")  # fmt: skip
    fused.add_argument("--rate", type=float, default=2e-4, help="learning rate of a fine-tuning")
    fused.add_argument("--data", type=Path, metavar="LAB", help="dataset or packs with labelled "
                       "probes of one piece, several a gripping")  # fmt: skip
    fused.add_argument("--labels", choices=LABEL_CHOICES, default="approved", help="which labels "
                       "of a dataset count")  # fmt: skip
    fused.add_argument("--mix-share", type=float, default=0.5, help="of simulated sequences in a "
                       "fine-tuning")  # fmt: skip


def train_fused(run: campaign.ExperimentRun) -> campaign.Json:
    """Train the network; copy it with its card to the folder of the experiment when it is done.

    Raises ``InputError`` for counts that leave no training or held-out data.
    """
    # Imported here so that `--help` starts without torch.
    from touchdown.backend.learning import card_path

    args, store = run.args, run.store
    half = args.parts // 2
    counts = {"short": args.parts - half, "more": half}
    counts |= {"free": args.free_parts, "long": args.long_parts, "longest": args.longest_parts}
    counts["surface"] = args.surface_parts
    known = all(n == 0 or 2 <= n <= experiments.PORTIONS[name].most for name, n in counts.items())
    known &= 1 <= args.networks <= MOST_NETWORKS
    others = args.long_parts + args.longest_parts + args.surface_parts
    known &= args.parts >= 4 or (args.parts == 0 and others > 0)
    known &= args.surface_parts == 0 or args.outlines == "any"
    known &= args.batch >= 1
    if not known or min(args.steps, args.seed) < 0:
        raise core.InputError(
            "A number of parts, networks or steps, batch or seed is out of range.",
            "--parts, --long-parts, --longest-parts, --free-parts, --surface-parts, --networks, "
            "--steps, --batch, --seed",
            "Give 4 to 120 parts, none or 2 to 400 long, 2 to 200 longest, 2 to 100 free and, with "
            "--outlines any, 2 to 180 on uneven bottoms (with one of them but free ones also no "
            f"others), and 1 to {MOST_NETWORKS} networks.",
        )
    bench, code = run.bench(), core.package_version("touchdown")
    ranges = experiments.read_ranges(args.ranges) if args.ranges else {}
    recipe = experiments.FusionRecipe(
        bench, code, counts, args.steps, args.seed, args.device,
        outlines=args.outlines, batch=args.batch, networks=args.networks, ranges=ranges,
        tuning=_tuning(run, bench), wrench_alone=args.wrench_alone,
    )  # fmt: skip
    if args.ready:
        recipe = replace(
            recipe, ready=experiments.ready_sequences(store, bench, args.outlines, ranges)
        )
        if any(len(some) == 1 for some in recipe.ready.values()) or not any(recipe.ready.values()):
            what = "There are too few finished sequences of this bench and family."
            fix = "Simulate at least two jobs of each portion, with --steps 0."
            raise core.InputError(what, str(store.root), fix)
    jobs = recipe.jobs()
    answer: campaign.Json = {"file": None, "fused": None}
    run.run(jobs)
    training, out = jobs[-1].id, args.out / experiments.WEIGHTS
    if args.steps and store.has(training):
        weights = store.folder(training) / experiments.WEIGHTS
        for made_there, wanted in ((card_path(weights), card_path(out)), (weights, out)):
            core.write_atomically(wanted, made_there.read_bytes())
        run.screen.say(f"The network is in {out}.")
        answer |= {"file": str(out), "fused": store.result(training)}
    return {**answer, **run.counts()}


def _tuning(run: campaign.ExperimentRun, bench: SimulationSettings) -> campaign.Json:
    """Return the parameters of a fine-tuning, {} for a training from scratch."""
    from touchdown.backend.learning import load_episodes

    args = run.args
    if args.pretrained is None and args.data is None:
        return {}
    if args.pretrained is None or not (0.0 < args.mix_share < 1.0 and 0.0 < args.rate < 1.0):
        raise core.InputError(
            "A fine-tuning needs a network, a learning rate, and simulated sequences beside the "
            "labelled ones.",
            "--from, --rate, --mix-share",
            "Name the network, with a rate and a share between 0 and 1.",
        )
    rows = None if args.data is None else load_episodes(args.data, None, args.labels)
    height_mm = bench.wrist.height_mm
    return experiments.adopt_tuning(
        run.store, args.pretrained, rows, height_mm, args.mix_share, args.rate
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "what",
        choices=("tables", "report", "beyond", "fused", "elsewhere", "certify"),
        help="tables: the paper's Tables I to III; report: write their page again, with other "
        "comparisons; beyond: strategies beyond the paper, and the ceiling; fused: train the "
        "network of the strategy 'fused'; elsewhere: evaluate in a second simulated world; "
        "certify: bound the unsafe releases of a network of 'fused' on fresh scenes",
    )
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument(
        "--quick", dest="scale", action="store_const", const="quick", help="existing models, a few "
        "probes and trials per cell (default)",
    )  # fmt: skip
    scale.add_argument(
        "--full", dest="scale", action="store_const", const="full", help="train as the paper does; "
        "400 positions and 100 trials per cell",
    )  # fmt: skip
    scale.add_argument(
        "--stability", dest="scale", action="store_const", const="stability", help="existing "
        "models, Tables I and II alone: 200 groups, and 800 presses on 40 mountings per cell",
    )  # fmt: skip
    parser.set_defaults(scale="quick")
    campaign.add_campaign_arguments(parser)
    _add_beyond_arguments(parser)
    add_evaluation_arguments(parser)
    add_fused_arguments(parser)
    add_report_arguments(parser)
    add_certify_arguments(parser)


def _add_beyond_arguments(parser: argparse.ArgumentParser) -> None:
    beyond = parser.add_argument_group("beyond")
    beyond.add_argument("--strategies", default="paper,fused", help="those of "
                        "'stack --strategy', and ceiling; "
                        "settings follow a name: fused:policy.least_probes=2")  # fmt: skip
    beyond.add_argument("--bottoms", default="short,long", help="or hex20, rect12x28, towers "
                        "short+long, short+hex20, short+rect12x28, and fresh: another outline in "
                        "each trial")  # fmt: skip
    beyond.add_argument("--outline-seed", default=FRESH_SEED, metavar="HEX", help="of the fresh "
                        "outlines, the hash of a commit (default: %(default).12s)")  # fmt: skip
    beyond.add_argument("--trials", type=int, default=50, help="of a cell")
    beyond.add_argument("--band", type=int, default=0, metavar="N", help="repeat the trials on N "
                        "benches with every nuisance half to twice as large")  # fmt: skip
    beyond.add_argument("--stop-early", choices=("placed", "unsafe"), help="end a comparison once "
                        "it is decided on this quantity (error 5 %%, at any time)")  # fmt: skip


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Run all unfinished jobs, then write the page; return 0 if no job failed."""
    if args.what == "report":
        file = args.tables or args.out / experiments.DATA
        with core.disk_errors(campaign.UNWRITTEN, file, campaign.KEPT):
            page = experiments.rewrite_tables(file, args.beyond)
        screen.say(f"Written: {page}")
        screen.result({"page": str(page), "file": str(file)})
        return 0
    this = campaign.ExperimentRun(args, screen)
    answer = WAYS[args.what](this)
    screen.result(answer)
    return 1 if this.failed else 0


def run_tables(run: campaign.ExperimentRun) -> campaign.Json:
    """Run the jobs of the paper's tables; write the page and the file of the results."""
    args = run.args
    recipe = _recipe(run)
    run.run(recipe.jobs())
    with core.disk_errors(campaign.UNWRITTEN, args.out, campaign.KEPT):
        page, answer = experiments.write_tables(args.out, recipe, run.store)
    if args.keep_models:
        with core.disk_errors(campaign.UNWRITTEN, args.keep_models, campaign.KEPT):
            args.keep_models.mkdir(parents=True, exist_ok=True)
            kept = experiments.keep_models(run.store, recipe, args.keep_models)
        run.screen.say(f"{len(kept)} models: {args.keep_models}")
    counts = run.counts()
    done = counts["jobs"] - counts["missing"]
    run.screen.say(f"{done} of {counts['jobs']} jobs are done: {page}")
    return {"page": str(page), **counts, "tables": answer}


def run_beyond(run: campaign.ExperimentRun) -> campaign.Json:
    """Run the trials of a comparison of strategies; write its page, its tables and its file."""
    args, screen = run.args, run.screen
    plan = _comparison_of(run)
    if args.stop_early:
        _run_rounds(plan, run)
    else:
        run.run(plan.jobs())
    answer = plan.answer(run.store, args.stop_early)
    if args.stop_early:
        screen.say(experiments.stopped_text(answer["stopped"]))
    with core.disk_errors(campaign.UNWRITTEN, args.out, campaign.KEPT):
        path = experiments.write_comparison(args.out, answer)
    for sheet in experiments.comparison_tables(answer):
        screen.table(sheet.title, *sheet.texts())
    return {"file": str(path), **run.counts(), "beyond": answer}


def _run_rounds(plan: experiments.StrategyComparison, run: campaign.ExperimentRun) -> None:
    """Run rounds of trials until all comparisons are decided, or a job failed.

    Raises ``InputError`` if there is nothing to compare, or only a shard of the trials.
    """
    args, store = run.args, run.store
    if args.shard or not experiments.decided_strategies(
        plan.loops.trials_of(store), args.stop_early
    ):
        what = "An early stop needs two strategies and all of their trials on one computer."
        fix = "Leave out --shard, and name a strategy and its reference with --strategies."
        raise core.InputError(what, "--stop-early", fix)
    while jobs := plan.next_round(store, args.stop_early):
        if not run.run(jobs):
            break


def _comparison_of(run: campaign.ExperimentRun) -> experiments.StrategyComparison:
    args, bench = run.args, run.bench()
    pieces = campaign.parse_names(args.pieces, experiments.COMPARED_PIECES, "--pieces")
    strategies = campaign.parse_strategies(args.strategies, experiments.STRATEGIES)
    require_positive(args, "trials")
    require_positive(args, "band", least=0)
    if not re.fullmatch("[0-9a-f]{8,64}", args.outline_seed):
        fix = "Give 8 to 64 hex digits."
        raise core.InputError(f"'{args.outline_seed}' is not a hash.", "--outline-seed", fix)
    found = run.models(bench)
    for piece in pieces:
        for name in strategies:
            _check_cell(piece, name, known=(piece, "FT+Tac") in found)
    loops = experiments.ClosedLoopComparison(
        bench=bench,
        code=core.package_version("touchdown"),
        models={piece: found.get((piece, "FT+Tac"), "") for piece in pieces},
        pieces=pieces,
        bottoms=campaign.parse_names(args.bottoms, experiments.BOTTOMS, "--bottoms"),
        strategies=strategies,
        trials=args.trials,
        outline_seed=args.outline_seed,
    )
    return experiments.StrategyComparison(loops, args.band)


def _check_cell(piece: str, name: str, *, known: bool) -> None:
    """Raise ``InputError`` if a strategy cannot serve a piece; ``known``: it has a model."""
    strategy = experiments.base_strategy(name)
    if not known and strategy not in experiments.MODEL_FREE:
        fix = f"Choose from {', '.join(experiments.MODEL_FREE)}."
        raise core.InputError(
            f"There is no model of '{piece}', which '{strategy}' needs.", name, fix
        )
    if strategy != experiments.CEILING:
        check_weighing(load_pieces().top(piece), experiments.method_of(name, StackSettings()))


def _recipe(run: campaign.ExperimentRun) -> experiments.Recipe:
    args, bench = run.args, run.bench()
    wanted = campaign.parse_names(args.pieces, experiments.PIECES, "--pieces")
    pieces = tuple(piece for piece in experiments.PIECES if piece in wanted)
    scale = experiments.SCALES[args.scale]
    if args.keep_models and not scale.probes:
        fix = "Leave it out or use --full."
        raise core.InputError(f"--{args.scale} trains no models.", "--keep-models", fix)
    if args.models and scale.probes:
        fix = "Leave it out or use --quick."
        raise core.InputError("--full trains its own models.", "--models", fix)
    models = {} if scale.probes else run.models(bench)
    return experiments.Recipe(
        scale, bench, core.package_version("touchdown"), models, pieces, args.device
    )


def add_evaluation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``elsewhere``."""
    asked = parser.add_argument_group("elsewhere")
    asked.add_argument("--groups", type=int, default=20, help="of three probes, in each cell")
    asked.add_argument("--gel", choices=("half-space", "finite-elements"), default="half-space",
                       help="of the second world")  # fmt: skip
    asked.add_argument("--first", type=int, default=0, metavar="N", help="number of the first "
                       "group and trial in each cell; tune on others than reported")  # fmt: skip


def run_evaluation(run: campaign.ExperimentRun) -> campaign.Json:
    """Run ``elsewhere`` and write its file.

    Raises ``InputError`` for counts without work, for unknown names, and if the second world lacks
    its engine.
    """
    from touchdown.backend.simulation import import_mujoco
    from touchdown.backend.simulation.second_world import import_skfem

    args, bench, code = run.args, run.bench(), core.package_version("touchdown")
    if min(args.groups, args.trials) < 0 or args.groups + args.trials == 0:
        fix = "Give a positive number of one."
        raise core.InputError("The counts give no presses.", "--groups, --trials", fix)
    (piece, *others) = campaign.parse_names(args.pieces, experiments.PIECES, "--pieces")
    if others:
        raise core.InputError("Only one piece is evaluated.", "--pieces", "Name one piece.")
    bottoms = campaign.parse_names(args.bottoms, experiments.TABLE_BOTTOMS, "--bottoms")
    strategies = campaign.parse_strategies(args.strategies, experiments.EVALUATED_STRATEGIES)
    require_positive(args, "first", least=0)
    import_mujoco()
    there = "elsewhere"
    if args.gel != "half-space":
        import_skfem()
        there = f"elsewhere-{args.gel}"
    found = run.models(bench)
    plan = experiments.DomainShift(
        bench=bench,
        code=code,
        piece=piece,
        models={n: found[piece, n] for n in ("FT+Tac", "FT") if (piece, n) in found},
        bottoms=bottoms,
        strategies=strategies,
        groups=args.groups,
        trials=args.trials,
        first=args.first,
        there=there,
    )
    run.run(plan.jobs())
    answer = plan.answer(run.store)
    for table in experiments.shift_tables(answer):
        run.screen.table(table.title, *table.texts())
    path = args.out / "elsewhere.json"
    campaign.write_json(path, answer)
    return {"file": str(path), **run.counts(), "elsewhere": answer}


KEPT_BESIDE = "Free some space, or copy the model to another folder; finished jobs are kept."


def add_certify_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``certify``."""
    group = parser.add_argument_group("certify")
    group.add_argument("--model", type=Path, metavar="FILE", help="network of 'fused' (default: "
                       "the one that ships); the certificate and the log of attempts lie "
                       "beside it")  # fmt: skip
    group.add_argument("--level", default="", metavar="RISK", help="accepted risk, chosen before "
                       "on other scenes; several separated by commas share the error")  # fmt: skip
    group.add_argument("--scenes", type=int, default=experiments.LEAST_SCENES, metavar="N",
                       help="fresh scenes of each level, at least "
                       f"{experiments.LEAST_SCENES:,}")  # fmt: skip


def run_certify(run: campaign.ExperimentRun) -> campaign.Json:
    """Run an attempt, write its counts to the log, and the certificate if its bound holds.

    Raises ``InputError`` for a missing level or too few scenes.
    """
    # Imported here so that `--help` starts without torch.
    from touchdown.backend.learning.fused import (
        AttemptLog,
        attempts_path,
        certificate_of_attempt,
        shipped_path,
        write_certificate,
    )

    screen = run.screen
    plan = _plan(run, run.args.model or shipped_path())
    log = AttemptLog(attempts_path(plan.weights))
    core.make_folder(run.store.root)  # before an attempt is spent
    attempt = plan.begin(log)
    screen.say(
        f"Attempt {attempt.number}, error {100 * attempt.error:.3g} % for each risk, seeds from "
        f"{attempt.seed}. It is spent, whatever comes out."
    )
    run.run(plan.jobs(attempt))
    counts = plan.counts(attempt, run.store)
    file = None
    if counts and attempt.state == "begun":
        attempt = log.closed(attempt, counts)
        found = certificate_of_attempt(attempt, simulated=True, pieces=experiments.PIECES)
        # The log last: an attempt that is interrupted here is continued.
        with core.disk_errors(campaign.UNWRITTEN, plan.weights.parent, KEPT_BESIDE):
            if found is not None:
                file = write_certificate(plan.weights.parent, plan.weights.stem, found)
        log.append(attempt)
        screen.say(
            "The bound exceeds 1 %: no certificate." if found is None
            else f"Certificate: {found.summary()}. It is in {file}."
        )  # fmt: skip
    for level in counts:
        screen.say(
            f"At a risk of {100 * level.risk:g} %: {level.unsafe:,} of {level.releases:,} releases "
            f"unsafe, at most {100 * level.bound:.2f} %; {level.placed:,} of {level.scenes:,} "
            f"scenes placed, harm in {level.harmed:,}."
        )
    answer = {"attempt": attempt.model_dump(mode="json")}
    path = run.args.out / "certify.json"
    campaign.write_json(path, answer)
    certificate = None if file is None else str(file)
    return {"file": str(path), "certificate": certificate, **run.counts(), **answer}


def _plan(run: campaign.ExperimentRun, weights: Path) -> experiments.Certification:
    args, bench = run.args, run.bench()
    try:
        risks = tuple(float(text) for text in args.level.split(","))
        if not all(0.0 < risk < 1.0 for risk in risks) or len(set(risks)) < len(risks):
            raise ValueError
    except ValueError as error:
        what = "A certificate is of a risk that was chosen before."
        fix = "Give a probability between 0 and 1, such as 0.03, or several different ones."
        raise core.InputError(what, "--level", fix) from error
    if args.scenes < experiments.LEAST_SCENES:
        fix = f"Give at least {experiments.LEAST_SCENES}."
        raise core.InputError(f"{args.scenes} scenes are too few.", "--scenes", fix)
    name, code = args.bench.stem if args.bench else bench.preset, core.package_version("touchdown")
    return experiments.Certification(bench, name, weights.resolve(), risks, args.scenes, code)


WAYS = {
    "tables": run_tables,
    "beyond": run_beyond,
    "fused": train_fused,
    "elsewhere": run_evaluation,
    "certify": run_certify,
}
