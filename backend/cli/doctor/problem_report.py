"""Problem report: checks, versions, settings, logs and the last run in one zip archive.

Home folder, account, computer and persons are replaced in every text. Files that cannot be read are
named in the archive and do not end the report.
"""

from __future__ import annotations

import io
import json
import os
import platform
import re
import zipfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from importlib.metadata import distributions
from pathlib import Path

from touchdown.backend import core
from touchdown.backend.cli.output import check_new
from touchdown.backend.cli.replay import find_run

FILE_BYTES = 20_000_000  # of a longer file the end is kept
TEXTS = {".csv", ".json", ".jsonl", ".md", ".toml", ".txt"}
PICTURES = {".jpeg", ".jpg", ".png"}
ENVIRONMENT = ("TOUCHDOWN_", "QT_", "OMP_", "XDG_", "DISPLAY", "WAYLAND_DISPLAY", "LANG")
# A person in JSON, also in a text inside JSON, and in TOML.
PERSON = re.compile(
    r'\b(?:person|actor|author|operator|reviewer)\\*"?\s*[:=]\s*\\*"((?:[^"\\\n]|\\+u[0-9a-f]{4})+)'
)


def write_report(
    out: Path, checks: object, *, lab: Path | None = None, pictures: bool = False,
    names: bool = False,
) -> list[str]:  # fmt: skip
    """Write the archive ``out``; return the names of its files.

    ``checks``: findings of the doctor, for JSON; ``lab``: lab file to include; ``pictures``:
    include those of the last run; ``names``: keep the names of persons, account, computer and home
    folder. Both together include its episode files. Raises ``InputError`` if ``out`` exists, and
    ``OSError`` if it cannot be written.
    """
    shown = (PICTURES if pictures else set()) | ({".mcap"} if pictures and names else set())
    facts = {"doctor.json": checks, "versions.json": _versions()}
    texts = {n: json.dumps(fact, indent=1, ensure_ascii=False) for n, fact in facts.items()}
    binary, answer = dict[str, bytes](), {True: "kept", False: "left out or replaced"}
    lines = [
        f"Problem report of {core.program_stamp()}\n",
        f"Names: {answer[names]}. Pictures: {answer[pictures]}.",
        "Notes are not changed. Read the files before you send them.",
    ]
    for name, path in _files(lab).items():
        kind = path.suffix.lower()
        if ".log" in path.suffixes or kind in TEXTS | shown:
            try:
                with path.open("rb") as file:
                    file.seek(max(0, path.stat().st_size - FILE_BYTES))
                    content = file.read(FILE_BYTES)
            except OSError as error:
                lines.append(f"Not readable: {name}: {error.strerror or error}.")
                continue
            if kind in shown:
                binary[name] = content
            else:
                texts[name] = content.decode(errors="replace")
    texts["README.txt"] = "\n".join(lines)
    clean = str if names else _redaction(texts.values())
    check_new(out)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in binary.items():
            archive.writestr(name, content)
        for name, text in texts.items():
            archive.writestr(name, clean(text))
    core.write_atomically(out, target.getvalue())
    return sorted([*texts, *binary])


def _files(lab: Path | None) -> dict[str, Path]:
    data = core.data_folder()
    folders = {"settings": core.config_folder(), "log": data / "log"}
    with suppress(core.InputError, OSError):
        folders["run"] = find_run("latest", data / "runs")
        folders["episodes"] = folders["run"] / "episodes"
    found = {"lab.toml": lab} if lab is not None else {}
    for name, folder in folders.items():
        found |= {f"{name}/{p.name}": p for p in sorted(folder.glob("*")) if not p.is_dir()}
    return found


def _versions() -> dict[str, object]:
    return {
        "program": core.program_stamp(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "system": platform.platform(),
        "packages": dict(sorted((d.name, d.version) for d in distributions())),
        "environment": {k: v for k, v in os.environ.items() if k.startswith(ENVIRONMENT)},
    }


def _people(texts: Iterable[str]) -> set[str]:
    from touchdown.backend.annotations import Dataset
    from touchdown.backend.runs import dataset_folder

    found = set[str]()
    for name in {name for text in texts for name in PERSON.findall(text)}:
        with suppress(ValueError):  # "J\\u00fcrgen" in a text inside JSON
            name = json.loads('"' + re.sub(r"\\+u", r"\\u", name) + '"')
        found.add(name)
    with (
        suppress(Exception),  # the report of a damaged dataset is written all the same
        Dataset.open(dataset_folder(), create=False, write=False) as dataset,
    ):
        found |= set(dataset.people())
    return found - {""}


def _redaction(texts: Iterable[str]) -> Callable[[str], str]:
    words = {person: f"<person {n}>" for n, person in enumerate(sorted(_people(texts)), start=1)}
    words |= {platform.node(): "<computer>", str(Path.home()): "~"}
    words[core.account_name()] = "<account>"
    forms = dict[str, str]()
    for word, new in words.items():
        for _ in range(3):  # as it is, in JSON, in a text inside JSON
            forms[word.lower()] = new
            word = json.dumps(word)[1:-1]
    forms.pop("", None)
    choice = "|".join(map(re.escape, sorted(forms, key=len, reverse=True)))
    # Letters around it make another word; an escaped line end does not.
    pattern = re.compile(rf"(?:(?<![^\W\d_])|(?<=\\[nrt]))(?:{choice})(?![^\W\d_])", re.IGNORECASE)

    def clean(line: str) -> str:
        lower = line.lower()
        if not any(form in lower for form in forms):
            return line  # as most of the long lines of an event log
        return pattern.sub(lambda found: forms.get(found[0].lower(), "<name>"), line)

    return lambda text: "".join(map(clean, text.splitlines(keepends=True)))
