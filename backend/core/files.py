"""Durable files: atomic writes, exclusive locks, and the name of the program that wrote them.

A file is either complete or absent. The system releases a lock when its process ends.
"""

from __future__ import annotations

import errno
import getpass
import json
import os
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from hashlib import sha256
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from io import FileIO
from pathlib import Path
from tempfile import TemporaryFile
from types import ModuleType
from typing import Any

from touchdown.backend.core.faults import InputError

# Reported by file systems whose folders cannot be synced (FAT).
UNSYNCABLE_ERRNOS = frozenset({errno.EINVAL, errno.ENOTSUP})


def data_folder() -> Path:
    """Return the operator's data folder: $TOUCHDOWN_DATA, else the XDG data folder."""
    return _operator_folder("TOUCHDOWN_DATA", "XDG_DATA_HOME", ".local/share")


def config_folder() -> Path:
    """Return the folder of the window settings: $TOUCHDOWN_CONFIG, else the XDG folder."""
    return _operator_folder("TOUCHDOWN_CONFIG", "XDG_CONFIG_HOME", ".config")


def _operator_folder(chosen: str, base: str, usual: str) -> Path:
    try:
        if named := os.environ.get(chosen):
            return Path(named).expanduser()
        return Path(os.environ.get(base) or Path.home() / usual) / "touchdown"
    except RuntimeError as error:
        fix = f"Name a folder in the variable {chosen}."
        raise InputError("The home folder of this account is unknown.", chosen, fix) from error


def account_name() -> str:
    """Return the name of the account, "" if it has none, such as a bare number in a container."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return ""


def sync_folder(folder: Path) -> None:
    """Make renames in ``folder`` durable (a no-op where folders cannot be synced).

    Raises ``OSError`` for any other failure.
    """
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in UNSYNCABLE_ERRNOS:
            raise
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Create ``folder`` and its missing parents, durably."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for made in reversed(missing):
        made.mkdir(exist_ok=True)
        sync_folder(made.parent)


def check_writable(folder: Path) -> None:
    """Raise ``OSError`` unless files can be made in ``folder``, which is created if missing."""
    make_folder(folder)
    with TemporaryFile(dir=folder) as file:
        file.write(b"\0")  # a full disk accepts empty files


def write_atomically(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path``: temporary name, fsync, rename, fsync of the folder.

    On an error ``path`` is unchanged and no temporary file remains.
    """
    make_folder(path.parent)
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        error.filename = str(path)  # the temporary name means nothing to the user
        with suppress(OSError):
            part.unlink()
        raise
    sync_folder(path.parent)


MAX_DEPTH = 64  # levels of objects and arrays in a foreign file
TOO_DEEP = f"it is nested deeper than {MAX_DEPTH} levels"


def parse_json(content: bytes | str) -> Any:
    """Parse JSON of any origin.

    Raises ``ValueError`` in a few words if it is not JSON in UTF-8 or nested deeper than
    ``MAX_DEPTH``.
    """
    return _parsed(json.loads, content, "utf-8-sig")


def parse_toml(content: bytes | str) -> dict[str, Any]:
    """Parse TOML of any origin; raises ``ValueError`` as ``parse_json``."""
    return dict(_parsed(tomllib.loads, content, "utf-8"))


def _parsed(parse: Callable[[str], Any], content: bytes | str, encoding: str) -> Any:
    try:
        text = content if isinstance(content, str) else content.decode(encoding)
        found = parse(text)
    except UnicodeDecodeError as error:
        raise ValueError(f"byte {error.start} is not text in UTF-8") from None
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    # Dotted keys of TOML nest without brackets.
    marks = map(text.count, "[{." if parse is tomllib.loads else "[{")
    level, depth = ([found] if sum(marks) > MAX_DEPTH else []), 0
    while level:
        depth += 1
        if depth > MAX_DEPTH:
            raise ValueError(TOO_DEEP)
        inner = (v.values() if isinstance(v, dict) else v for v in level)
        level = [v for values in inner for v in values if isinstance(v, dict | list)]
    return found


@contextmanager
def disk_errors(what: str, where: Path, fix: str) -> Iterator[None]:
    """Raise ``InputError`` for an error of the disk; ``what`` ends without its full stop."""
    try:
        yield
    except OSError as error:
        place = str(error.filename or where)
        raise InputError(f"{what}: {error.strerror or error}.", place, fix) from error


@contextmanager
def errors_as_input(
    what: str, where: Path | str, fix: str, *kinds: type[Exception]
) -> Iterator[None]:
    """Raise ``InputError`` for an error of ``kinds``; ``what`` ends without its full stop."""
    try:
        yield
    except kinds as error:
        raise InputError(f"{what}: {error}.", str(where), fix) from error


def check_file(path: Path, fix: str) -> None:
    """Raise ``InputError`` for a folder, and for a pipe or a device, which may never end."""
    if path.exists() and not path.is_file():
        raise InputError("This is not a file.", str(path), fix)


def read_limited(path: Path, limit: int, fix: str) -> bytes:
    """Return a file of at most ``limit`` bytes; raises ``InputError`` with ``fix``."""
    with disk_errors("Cannot read the file", path, fix):
        check_file(path, fix)
        if path.stat().st_size > limit:
            what = f"The file is too large: more than {limit / 1e6:g} MB."
            raise InputError(what, str(path), fix)
        return path.read_bytes()


def append_line(path: Path, line: bytes) -> None:
    """Append a line (or several, without the last line feed) to a file durably; make its folder.

    An incomplete last line, which a crash may have left, is cut off. Raises ``OSError``; then
    nothing is appended.
    """
    if is_new := not path.exists():
        make_folder(path.parent)
    with path.open("a+b", buffering=0) as file:
        end, rest = _end_of_lines(file), memoryview(line + b"\n")
        file.truncate(end)
        try:
            while rest:
                rest = rest[file.write(rest) :]
            os.fsync(file.fileno())
        except OSError:
            with suppress(OSError):
                file.truncate(end)
            raise
    if is_new:
        sync_folder(path.parent)


def _end_of_lines(file: FileIO) -> int:
    """Return the offset behind the last line feed, 0 without one."""
    size = start = file.seek(0, os.SEEK_END)
    length, end = 1, 0
    while start and not end:
        start = max(0, size - length)
        file.seek(start)
        end, length = file.read().rfind(b"\n") + 1, 4096 * length
    return start + end


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects of a file of JSON lines; empty if it does not exist.

    Incomplete lines are skipped. Raises ``InputError`` if the file cannot be read.
    """
    with disk_errors("The file cannot be read", path, "Check its permissions."):
        content = path.read_bytes() if path.is_file() else b""
    found = []
    for raw in content.splitlines():
        with suppress(ValueError):
            if isinstance(line := parse_json(raw), dict):
                found.append(line)
    return found


_FAR_BYTE = 1 << 20  # A Windows lock also blocks reading, so a byte far behind the text is locked


def lock_file(path: Path) -> int:
    """Lock ``path`` (created if missing) until the returned descriptor is closed.

    Raises ``BlockingIOError`` if it is locked already.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _lock(descriptor)
    except OSError as error:
        os.close(descriptor)
        raise BlockingIOError(f"{path} is locked") from error
    return descriptor


def _lock(descriptor: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        os.lseek(descriptor, _FAR_BYTE, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        os.lseek(descriptor, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


@lru_cache(maxsize=8)
def package_version(package: str) -> str:
    """Return the version of an installed package, "" if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


__version__ = package_version("touchdown")


def require_package(module: str, extra: str = "exchange", package: str = "") -> ModuleType:
    """Import an optional package; raises ``InputError`` with its extra if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        what = f"The package '{package or module.partition('.')[0]}' is not installed."
        fix = f"Install it: pip install 'touchdown[{extra}]'."
        raise InputError(what, f"extra '{extra}'", fix) from error


def hash_files(paths: Iterable[Path], root: Path) -> str:
    """Return 16 hex digits of the contents of ``paths`` and of their names below ``root``."""
    digest = sha256()
    for path in sorted(paths):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


@lru_cache(maxsize=1)
def program_version() -> str:
    """Return version and hash of the sources, such as ``0.1.0+9f86d081884c7d65``.

    The sources are those of ``touchdown.backend`` and the TOML files of the resources.
    """
    backend = Path(__file__).resolve().parents[1]
    paths = [*backend.rglob("*.py"), *backend.parent.glob("resources/**/*.toml")]
    return f"{package_version('touchdown')}+{hash_files(paths, backend.parent)}"


def program_stamp() -> str:
    """Return name, version and hash of the sources of this program."""
    return f"touchdown {program_version()}"
