"""The wheel adds ``touchdown`` alone, and runs beside folders of the same names as its parts."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("app", "backend", "resources", "widgets")
WRITTEN = ROOT / "tests" / "data" / "written_0_1"
# Packages of the extras, which the base runs without; an import of one fails.
EXTRAS = "PySide6 shiboken6 pyqtgraph trimesh ezdxf svgelements distributed mujoco foxglove skfem"
EXCHANGE = "pyarrow av h5py zarr"
REFUSING = (
    f"import os, sys; sys.modules.update(dict.fromkeys("
    f"os.environ.get('ABSENT', '{EXTRAS} {EXCHANGE}').split()))"
)
BUILD = "from setuptools import build_meta; print(build_meta.build_{kind}({out!r}))"


def tracked() -> list[str]:
    done = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip("not a git checkout")
    return [name for name in done.stdout.splitlines() if (ROOT / name).is_file()]


def build(kind: str, source: Path, out: Path) -> Path:
    done = subprocess.run(
        [sys.executable, "-c", BUILD.format(kind=kind, out=str(out))],
        cwd=source, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return out / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Path]]:
    """The wheel built from a copy of the tree, and the one built from the sdist."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in tracked():
        if not name.startswith(("tests/", "docs/")):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    direct = build("wheel", source, folder / "direct")
    sdist = build("sdist", source, folder / "sdist")
    shutil.unpack_archive(sdist, folder / "unpacked")
    unpacked = next((folder / "unpacked").iterdir())
    yield direct, build("wheel", unpacked, folder / "again")
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def installed(
    wheels: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Path, Path]]:
    """An environment with the wheel in it, and a folder with packages of the parts' names.

    The dependencies are those of the environment of the tests, without the extras.
    """
    folder = tmp_path_factory.mktemp("installed")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    site = Path(sysconfig.get_path("purelib", vars={"base": str(folder / "venv")}))
    (site / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n{REFUSING}\n")
    before = {path.name for path in site.iterdir()}
    with zipfile.ZipFile(wheels[0]) as wheel:
        wheel.extractall(site)
    added = {p.name for p in site.iterdir()} - before
    assert {name for name in added if not name.endswith(".dist-info")} == {"touchdown"}
    laboratory = folder / "laboratory"
    for part in PARTS:
        (laboratory / part).mkdir(parents=True)
        (laboratory / part / "__init__.py").write_text(f'raise ImportError("{part} of the lab")\n')
    yield python, laboratory
    shutil.rmtree(folder)


def run(installed: tuple[Path, Path], *words: str | Path, most: int = 0) -> str:
    """Return what a command says whose status is at most ``most``."""
    python, laboratory = installed
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        [python, *words], cwd=laboratory, env=clean, capture_output=True, text=True, timeout=300,
        check=False,
    )  # fmt: skip
    assert 0 <= done.returncode <= most, done.stderr[-3000:] + done.stdout[-500:]
    return done.stdout


def verb(installed: tuple[Path, Path], *words: str | Path, most: int = 0) -> str:
    return run(installed, "-m", "touchdown", *words, most=most)


def test_the_wheel_holds_the_tree_and_nothing_else(wheels: tuple[Path, Path]) -> None:
    with zipfile.ZipFile(wheels[0]) as wheel:
        names = {n for n in wheel.namelist() if ".dist-info/" not in n}
    kinds = (".py", ".pyi", "py.typed")
    wanted = {
        name if name.startswith("touchdown/") else f"touchdown/{name}"
        for name in tracked()
        if name.split("/")[0] in (*PARTS, "touchdown")
        and (name.endswith(kinds) or name.startswith("resources/"))
    }
    assert names == wanted


def test_the_sdist_builds_the_same_wheel(wheels: tuple[Path, Path]) -> None:
    with zipfile.ZipFile(wheels[0]) as direct, zipfile.ZipFile(wheels[1]) as again:
        contents = [
            {n: w.read(n) for n in w.namelist() if ".dist-info/" not in n} for w in (direct, again)
        ]
    assert contents[0] == contents[1]


def test_a_piece_is_stacked_beside_folders_of_the_same_names(
    installed: tuple[Path, Path], tmp_path: Path
) -> None:
    said = verb(installed, "stack", "--seed", "7", "--no-episodes", "--json", "--runs", tmp_path)
    assert json.loads(said)["trials"][0]["outcome"] == "placed"


def test_a_script_beside_such_folders_imports_ours(installed: tuple[Path, Path]) -> None:
    script = installed[1] / "script.py"
    script.write_text(
        "import touchdown.backend.runs, touchdown.resources, touchdown.widgets\n"
        "import touchdown.app\n"
        "print(touchdown.backend.runs.StackRequest().piece)\n"
    )
    assert run(installed, script).split() == ["pot"]


@pytest.mark.slow
def test_each_child_process_starts_from_the_wheel(
    installed: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pool, training, emulated bench with its rig, and the reader of foreign files.

    Without Qt and the packages of the extras; the foreign reader has those of `exchange`.
    """
    data, model = tmp_path / "data", tmp_path / "pot.safetensors"
    verb(
        installed, "simulate", "--piece", "pot", "--bottoms", "circle15,square15",
        "--episodes", "40", "--workers", "2", "--out", data,
    )  # fmt: skip
    verb(
        installed, "train", data, "--piece", "pot", "--out", model, "--epochs", "1",
        "--divide-series", "--json",
    )  # fmt: skip
    assert model.is_file()
    shutil.unpack_archive(WRITTEN / "dataset.zip", tmp_path / "written")
    dataset = next(p.parent for p in (tmp_path / "written").rglob("dataset.json"))
    states = ("--states", "draft")
    verb(installed, "export", "csv", "--dataset", dataset, "--out", tmp_path / "csv", *states)
    monkeypatch.setenv("ABSENT", EXTRAS)
    verb(
        installed, "export", "lerobot", "--dataset", dataset, "--out", tmp_path / "out",
        "--states", "draft,submitted,approved", "--video", "none",
    )  # fmt: skip
    verb(
        installed, "import", "lerobot", tmp_path / "out", "--dataset", tmp_path / "taken",
        "--person", "ann",
    )  # fmt: skip
    # Ends after one press, with status 1 where the piece may not be released there.
    emulated = ("stack", "--emulated", "--strategy", "pick-and-place", "--no-episodes", "--json")
    (trial,) = json.loads(verb(installed, *emulated, "--runs", tmp_path, most=1))["trials"]
    assert trial["outcome"]


def test_a_release_needs_a_clean_tree_a_section_of_the_changelog_and_a_free_tag(
    tmp_path: Path,
) -> None:
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "release", tmp_path / ".ci")
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "1.2.3"\n')
    changes = tmp_path / "CHANGELOG.md"

    def git(*words: str) -> None:
        subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=tmp_path,
                       check=True, capture_output=True)  # fmt: skip

    def check() -> str:
        words = ["bash", ".ci/release", "--check"]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        return done.stdout if done.returncode == 0 else done.stderr

    def commit(text: str) -> None:
        changes.write_text(text)
        git("add", "--all")
        git("commit", "--quiet", "--message", "x")

    git("init", "--quiet")
    commit("## Unreleased\n\n- A\n\n## 1.2.2 - 2026-01-01\n\n- B\n")
    assert "no section '## 1.2.3 - YYYY-MM-DD'" in check()
    commit("## 1.2.3 - 2026-02-02\n\n## 1.2.2 - 2026-01-01\n\n- B\n")
    assert "no section" in check()
    commit("## 1.2.3 - 2026-02-02\n\n- A\n\n## 1.2.2 - 2026-01-01\n\n- B\n")
    assert check() == "release: 1.2.3 can be made\n"
    git("tag", "v1.2.3")
    assert "can be made" in check()
    changes.write_text("other")
    assert "not committed" in check()
    commit(changes.read_text() + "\n## 1.2.3 - 2026-02-02\n\n- A\n")
    assert "the tag v1.2.3 names another commit" in check()
