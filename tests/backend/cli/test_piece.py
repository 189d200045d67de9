""""""

import json

import trimesh

from touchdown.backend.cli.command_line import main
from touchdown.backend.geometry.pieces import load_pieces


def test_an_added_piece_is_listed_shown_and_stacked_by_name(tmp_path, capsys):
    path = tmp_path / "My Stub.stl"
    trimesh.creation.box((20.0, 24.0, 40.0)).export(path)
    assert main(["piece", "add", str(path), "--density", "1.24", "--json"]) == 0
    added = json.loads(capsys.readouterr().out)
    assert (added["piece"], added["parts"], added["holes"]) == ("my-stub", 1, 0)
    assert added["mass_g"] == 1.24e-3 * added["volume_mm3"]
    assert main(["piece", "list"]) == 0
    assert "My stub" in capsys.readouterr().out
    assert main(["piece", "show", "my-stub", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sha256"] == load_pieces().piece("my-stub").sha256
    words = ["stack", "--piece", "my-stub", "--strategy", "pick-and-place", "--json", "--no-log"]
    assert main(words[:-1]) in (0, 1, 2)
    capsys.readouterr()
    assert main(["piece", "add", str(path), "--density", "1.24"]) == 2
    assert "already a piece 'my-stub'" in capsys.readouterr().err


def test_a_bottom_is_written_to_a_folder_and_told_with_its_command(tmp_path, capsys):
    path = tmp_path / "foot.ply"
    trimesh.creation.cylinder(radius=12.0, height=30.0, sections=96).export(path)
    out = tmp_path / "mine"
    words = ["piece", "add", str(path), "--mass", "30", "--role", "bottom", "--out", str(out)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert f"--bottom foot --pieces {out}" in said
    assert load_pieces(out).bottom("foot").face.radius_mm == 12.0
    assert main(["piece", "list", "--pieces", str(out), "--json"]) == 0
    assert "foot" in [p["name"] for p in json.loads(capsys.readouterr().out)["pieces"]]


def test_a_missing_argument_is_reported(capsys):
    assert main(["piece", "add"]) == 2
    assert "needs an argument" in capsys.readouterr().err
    assert main(["piece", "list", "my-stub"]) == 2
    assert "takes no argument" in capsys.readouterr().err
