"""``touchdown piece``: add pieces from CAD files, list the known pieces, and show one."""

from __future__ import annotations

import argparse
from math import isnan
from pathlib import Path
from typing import get_args

from touchdown.backend import geometry
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("action", choices=("add", "list", "show"), help="what to do")
    add(
        "source", nargs="?", help="add: mesh (STL, OBJ, PLY, OFF) or outline (SVG, DXF); show: name"
    )
    add("--face", choices=get_args(geometry.PieceEnd), help="side of the mesh that is the contact "
        "face (default: bottom; of a bottom: top)")  # fmt: skip
    add("--role", choices=get_args(geometry.PieceRole), default="top",
        help="top: is grasped and placed; bottom: is stacked upon; both")  # fmt: skip
    add("--units", choices=tuple(geometry.UNITS_MM),
        help="unit of the file (default: the one named in it, mm)")  # fmt: skip
    add("--density", type=float, metavar="G_CM3", help="uniform density")
    add("--mass", type=float, metavar="G", help="mass, instead of a density")
    add("--height", type=float, metavar="MM", help="height over a drawn outline")
    add("--grip", type=float, metavar="MM",
        help="height of the grip above the face (default: 0.7 of the height)")  # fmt: skip
    add("--com", choices=get_args(geometry.CentreOfMass),
        help="centre of mass: uniform density, or unknown and weighed by each run (default: "
        "uniform, but unknown for an outline with --mass)")  # fmt: skip
    add("--name", help="name of the piece (default: that of the file)")
    add("--title", default="", help="title (default: from the name)")
    add("--out", type=Path, metavar="FOLDER", help="folder (default: pieces in the data folder)")
    add("--pieces", type=Path, metavar="DIR", help="folder with further piece files")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Add, list or show; ``InputError`` for files and names that cannot be used."""
    if args.action == "list":
        if args.source:
            raise InputError("'piece list' takes no argument.", args.source, "Leave it out.")
        return _list(args, screen)
    if not args.source:
        fix = "Name the file." if args.action == "add" else "See 'touchdown piece list'."
        raise InputError(f"'piece {args.action}' needs an argument.", "touchdown piece", fix)
    return _add(args, screen) if args.action == "add" else _show(args, screen)


def _add(args: argparse.Namespace, screen: VerbOutput) -> int:
    source = Path(args.source)
    wanted = geometry.PieceImport(
        args.face, args.role, args.units, args.density, args.mass, args.height, args.grip, args.com
    )
    measured = geometry.measure_piece(source, wanted)
    name = args.name or geometry.piece_name(source)
    written, picture = geometry.save_piece(measured, name, args.title, args.out)
    screen.say(f"Piece '{name}' is written to {written}, its picture to {picture}.")
    for line in (*_words(measured), *measured.notes):
        screen.say(line)
    where = f" --pieces {args.out}" if args.out else ""
    if args.role != "bottom":
        screen.say(
            f"A grasped piece needs a model: 'touchdown simulate --piece {name}{where}', then "
            "'touchdown train', then 'touchdown stack --model FILE' (docs/formats.md)."
        )
    else:
        screen.say(f"Use it with 'touchdown stack --bottom {name}{where}'.")
    screen.result({
        "piece": name, "written": str(written), "picture": str(picture), "role": measured.role,
        "height_mm": measured.height_mm, "volume_mm3": measured.volume_mm3,
        "area_mm2": measured.face.area, "mass_g": measured.mass_g,
        "com_mm": [None if isnan(value) else value for value in measured.com_mm],
        "grip_height_mm": measured.grip_mm, "width_mm": measured.width_mm,
        "parts": len(measured.face.geoms),
        "holes": sum(len(part.interiors) for part in measured.face.geoms),
        "notes": measured.notes,
    })  # fmt: skip
    return 0


def _words(piece: geometry.MeasuredPiece) -> tuple[str, ...]:
    x, y, z = piece.com_mm
    holes = sum(len(part.interiors) for part in piece.face.geoms)
    grip = "" if piece.width_mm is None else (
        f"Grip: {piece.width_mm:.1f} mm wide, {piece.grip_mm:.1f} mm above the face."
    )  # fmt: skip
    lines = (
        f"Face: {piece.face.area:.1f} mm², {len(piece.face.geoms)} part(s), {holes} hole(s).",
        f"Height {piece.height_mm:.2f} mm, volume {1e-3 * piece.volume_mm3:.2f} cm³, "
        f"mass {piece.mass_g:.1f} g.",
        ""
        if isnan(x)
        else f"Centre of mass: {x:.2f}, {y:.2f} mm from the middle of the face, "
        f"{z:.2f} mm above the underside.",
        grip,
    )
    return tuple(line for line in lines if line)


def _list(args: argparse.Namespace, screen: VerbOutput) -> int:
    library = geometry.load_pieces(args.pieces)
    pieces = [library.pieces[name] for name in sorted(library.pieces)]
    rows = [
        (p.name, p.title, ", ".join(p.roles), f"{p.height_mm:.1f}", f"{p.mass_g:.1f}", p.source)
        for p in pieces
    ]
    header = ("name", "title", "roles", "height, mm", "mass, g", "file")
    screen.table("Pieces", header, *rows, right=("height, mm", "mass, g"))
    for name, error in library.broken.items():
        screen.say(f"{name} cannot be used: {error.what} ({error.where})")
    screen.result({
        "pieces": [_facts(piece) for piece in pieces],
        "broken": {name: error.what for name, error in library.broken.items()},
    })  # fmt: skip
    return 0


def _show(args: argparse.Namespace, screen: VerbOutput) -> int:
    piece = geometry.load_pieces(args.pieces).piece(args.source)
    facts = _facts(piece)
    screen.table(piece.title, ("", ""), *((key, str(value)) for key, value in facts.items()))
    screen.result(facts)
    return 0


def _facts(piece: geometry.Piece) -> dict[str, object]:
    return {
        "name": piece.name, "title": piece.title, "roles": list(piece.roles),
        "height_mm": piece.height_mm, "mass_g": piece.mass_g,
        "com_xy_mm": list(piece.com_xy_mm) if piece.com_known else "unknown",
        "com_height_mm": piece.com_height_mm, "area_mm2": round(piece.face.area_mm2, 3),
        "grip_height_mm": piece.grip_height_mm, "width_mm": piece.width_mm,
        "fixed": piece.fixed, "file": piece.source, "sha256": piece.sha256,
    }  # fmt: skip
