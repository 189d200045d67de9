"""``touchdown models``: simulate, train and measure the shipped models."""

from __future__ import annotations

import argparse
import io
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

from touchdown.backend.cli import evaluate, simulate, train
from touchdown.backend.cli.output import VerbOutput, require_positive
from touchdown.backend.core import make_folder
from touchdown.backend.geometry import load_pieces

TRAINING_BOTTOMS = "circle15,circle25,square15"
UNSEEN_BOTTOMS = "short,long,hex20,rect12x28"
# Test episodes have other seeds than training episodes, so they share no grip.
TEST_SEED_OFFSET = 1_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("--pieces", default="pot,mushroom,barrel", help="separated by commas")
    add("--pieces-dir", type=Path, metavar="DIR", help="folder with further piece files")
    add("--out", type=Path, default=Path("resources/models"), metavar="DIR")
    add("--episodes", type=int, default=2000, help="per training bottom")
    add("--test-episodes", type=int, default=400, help="per unseen bottom")
    add("--epochs", type=int, help="default: that of 'touchdown train'")
    add("--seed", type=int, default=1)
    add("--probes-per-grip", type=int, default=1)
    add("--grips-per-mounting", type=int, default=1)
    add("--workers", type=int, default=2, help="processes that simulate")
    add("--threads", type=int, default=1, help="processor threads that train")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Make every model; return 0 if all are written."""
    began_s = time.monotonic()
    answer: dict[str, object] = {}
    counts = (key for key, value in vars(args).items() if type(value) is int and key != "seed")
    require_positive(args, *counts)
    require_positive(args, "seed", least=0)
    library = load_pieces(args.pieces_dir)
    pieces = [library.top(name).name for name in args.pieces.split(",")]
    make_folder(args.out)
    for piece in pieces:
        with TemporaryDirectory(prefix="touchdown-models-") as folder:
            answer[piece] = _make(args, piece, Path(folder), screen)
    screen.result({"models": answer, "seconds": round(time.monotonic() - began_s, 1)})
    return 0


def _make(
    args: argparse.Namespace, piece: str, folder: Path, screen: VerbOutput
) -> dict[str, object]:
    # Imported here so that `touchdown --help` starts without torch.
    from touchdown.backend.config import StabilitySettings
    from touchdown.backend.episodes import load_rows
    from touchdown.backend.geometry import face_points
    from touchdown.backend.learning import evaluate_model as measure
    from touchdown.backend.learning import load_checkpoint, save_card

    out = args.out / f"{piece}.safetensors"
    draw = ["--probes-per-grip", args.probes_per_grip, "--workers", args.workers]
    draw += ["--grips-per-mounting", args.grips_per_mounting, "--piece", piece]
    draw += ["--pieces", args.pieces_dir] if args.pieces_dir else []
    known = ["--bottoms", TRAINING_BOTTOMS, "--episodes", args.episodes, "--seed", args.seed]
    _run_verb(simulate, [*draw, *known, "--out", folder / "train"], screen)
    words = [folder / "train", "--piece", piece, "--out", out, "--threads", args.threads]
    _run_verb(train, words + (["--epochs", args.epochs] if args.epochs else []), screen)
    unseen = ["--bottoms", UNSEEN_BOTTOMS, "--episodes", args.test_episodes]
    unseen += ["--seed", args.seed + TEST_SEED_OFFSET]
    _run_verb(simulate, [*draw, *unseen, "--out", folder / "test"], screen)

    checkpoint = load_checkpoint(out)
    points = face_points(load_pieces(args.pieces_dir).piece(piece).face)
    delta = StabilitySettings().delta
    scores = measure(checkpoint, load_rows(folder / "test", piece), points, delta)
    screen.show(evaluate.score_table(f"{piece}, unseen bottoms (simulated)", scores, set()))
    figures = {name: score.as_json() for name, score in scores.items()}
    recipe = {key: value for key, value in vars(args).items() if type(value) is int}
    card = checkpoint.card.model_copy(
        update={
            "metrics": {**checkpoint.card.metrics, "unseen_bottoms": figures},
            "data": {**checkpoint.card.data, "recipe": {"verb": "models", **recipe}},
        }
    )
    save_card(out, card)
    return {"out": str(out), "scores": figures}


def _run_verb(verb: ModuleType, words: list[object], screen: VerbOutput) -> None:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    verb.add_arguments(parser)
    inner = VerbOutput(json=True, stream=io.StringIO()) if screen.json else screen
    verb.run(parser.parse_args([str(word) for word in words]), inner)
