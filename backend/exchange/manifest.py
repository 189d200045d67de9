"""Manifest of an export (``manifest.json``): episodes, query, revisions, geometry, program."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from touchdown.backend.annotations import SCHEMA_VERSION, Dataset, file_sha256
from touchdown.backend.core import errors_as_input, parse_json, program_stamp, write_atomically
from touchdown.backend.exchange.features import FPS, Feature
from touchdown.backend.exchange.query import (
    ExportQuery,
    SelectedEpisode,
    Selection,
    indices_by_side,
)

MANIFEST_NAME = "manifest.json"
VERSION = 1
GEOMETRY = "geometry"
MAX_BYTES = 2_000_000_000
Manifest = dict[str, Any]


def make_manifest(
    dataset: Dataset,
    format_name: str,
    query: ExportQuery,
    selection: Selection,
    features: Sequence[Feature],
) -> Manifest:
    """Return the manifest of an export without its files and encoding."""
    chosen = selection.chosen
    revisions = [one.revision for one in chosen]
    # The geometry records that the labels refer to.
    geometry = {one.revision.geometry for one in chosen}
    for record in [dataset.geometry.read(pair) for pair in geometry]:
        geometry |= {str(record[name]) for name in ("face", "bottom", "grid")}
    resolved = {name: getattr(query, name) for name in ExportQuery.__slots__}
    return {
        "version": VERSION,
        "format": format_name,
        "created_ns": time.time_ns(),
        "program_version": program_stamp(),
        "schema_version": SCHEMA_VERSION,
        "dataset_uuid": dataset.description.uuid,
        "query": {"text": query.text(), "resolved": resolved | {"states": list(query.states)}},
        "episodes": [_episode(one) for one in chosen],
        "geometry": sorted(geometry),
        "label_states": dict(sorted(Counter(r.state for r in revisions).items())),
        "label_sources": dict(sorted(Counter(r.source for r in revisions).items())),
        "feature_spec": {
            "fps": FPS,
            "features": [
                {"key": f.key, "dtype": f.dtype, "shape": list(f.shape), "constant": f.constant}
                for f in features
            ],
        },
        "splits": indices_by_side(chosen),
        "site_heads": dataset.labels.chain_heads(),
        "warnings": list(selection.warnings),
    }


def _episode(one: SelectedEpisode) -> dict[str, object]:
    entry, revision, label = one.entry, one.revision, one.revision.label
    return {
        "uuid": entry.uuid,
        "file_sha256": entry.sha256,
        "rev_uuid": revision.rev_uuid,
        "export_index": one.index,
        "piece": entry.piece,
        "bottom": entry.bottom,
        "geometry": revision.geometry,
        "grip_id": entry.grip_id,
        "mounting_id": entry.mounting_id,
        "person": entry.person,
        "mode": entry.mode,
        "recorded_ns": entry.recorded_ns,
        "split": one.split,
        "label": {name: getattr(label, name) for name in type(label).__slots__},
        "source": revision.source,
        "state": revision.state,
        "verdict": revision.verdict,
    }


def write_manifest(folder: Path, manifest: Manifest) -> str:
    """List the files of ``folder`` in the manifest and write it last; returns its SHA-256."""
    found = (path for path in folder.rglob("*") if path.is_file())
    paths = sorted(
        path for path in found if path != folder / MANIFEST_NAME and path.name[:10] != ".touchdown"
    )
    manifest["files"] = [
        {
            "path": path.relative_to(folder).as_posix(),
            "bytes": path.stat().st_size,
            "sha256": file_sha256(path),
        }
        for path in paths
    ]
    content = json.dumps(manifest, indent=1, ensure_ascii=False, allow_nan=False).encode("utf-8")
    write_atomically(folder / MANIFEST_NAME, content)
    return sha256(content).hexdigest()


def read_manifest(folder: Path) -> Manifest | None:
    """Return the verified manifest of an export, None if there is none.

    Raises ``InputError`` if it cannot be read, or if a file is missing or changed.
    """
    path = folder / MANIFEST_NAME
    if not path.is_file():
        return None
    said, fix = "The manifest of this export cannot be used", "Export again."
    with errors_as_input(said, path, fix, OSError, ValueError, KeyError, TypeError):
        if path.stat().st_size > MAX_BYTES:
            raise ValueError("it is too large")
        manifest = parse_json(path.read_bytes())
        if manifest["version"] != VERSION:
            raise ValueError(f"its version is {manifest['version']}, not {VERSION}")
        _check_files(folder, manifest["files"])
    return dict(manifest)


def _check_files(folder: Path, files: Sequence[Mapping[str, Any]]) -> None:
    for listed in files:
        path = folder / str(listed["path"])
        if not path.resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"{listed['path']} lies outside the export")
        if not path.is_file() or path.stat().st_size != listed["bytes"]:
            raise ValueError(f"{listed['path']} is missing or cut short")
        if file_sha256(path) != listed["sha256"]:
            raise ValueError(f"{listed['path']} was changed since it was exported")
