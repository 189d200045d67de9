"""Where a training set comes from: its benches, and a manifest that names every episode in it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from hashlib import sha256
from pathlib import Path

from pydantic import ValidationError

from backend.catalogue.training_set import is_dataset
from backend.config.bench_facts import BenchFacts, simulated_facts
from backend.config.simulation import SimulationSettings
from backend.core.faults import InputError
from backend.dataset.contents import read_first
from backend.dataset.rows import TrainingRows, find_packs
from backend.dataset.splits import Split, divided

MANIFEST = "manifest.json"
SIMULATED_MODES = frozenset({"emulated", "live simulation", "stepped", "mass"})
_NAMED = ("episode", "revision", "file_sha256", "x_um", "y_um", "bottom", "grip_id", "mounting_id")


def manifest_of(rows: TrainingRows, split: Split) -> bytes:
    """Return the manifest as JSON: equal episodes, labels and sides give equal bytes."""
    held_out = set(split.held_out.tolist())
    episodes = [
        {name: label[name] for name in _NAMED if name in label}
        | {"split": "held out" if i in held_out else "train"}
        for i, label in enumerate(rows.labels)
    ]
    content: dict[str, object] = {
        "version": 1,
        "format": "training-set",
        "piece": rows.piece,
        "geometry": rows.geometry,
        "kept_together": split.kept_together,
        "episodes": episodes,
    }
    if warnings := _leaks(rows, [str(one["split"]) for one in episodes]):
        content["warnings"] = warnings
    return json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False).encode() + b"\n"


def _leaks(rows: TrainingRows, sides: Sequence[str]) -> list[str]:
    """Return what validation knows of training: nothing where whole mountings were held out."""
    count = len(divided(sides, list(zip(rows.mounting_id, rows.bottom, strict=True))))
    if not count:
        return []
    return [
        f"Leakage: {count} episodes share mounting and bottom with the other side, so validation "
        "knows their errors."
    ]


def manifest_digest(manifest: bytes) -> str:
    """Return the SHA-256 that a model card keeps."""
    return sha256(manifest).hexdigest()


def only_simulated(rows: TrainingRows) -> bool:
    """Whether no episode was recorded on a real bench (packs are simulated, always)."""
    return all(label.get("mode", "mass") in SIMULATED_MODES for label in rows.labels)


def benches_of(data: Path, rows: TrainingRows) -> tuple[BenchFacts, ...]:
    """Return the distinct benches that the files of ``rows`` name; one file a mounting is read."""
    files = _one_per_mounting(data, rows) if is_dataset(data) else _packs(data)
    found = {
        facts.model_dump_json(): facts for path in files if (facts := _facts(path)) is not None
    }
    return tuple(facts for _, facts in sorted(found.items()))


def _one_per_mounting(data: Path, rows: TrainingRows) -> Iterable[Path]:
    chosen = dict(zip(rows.mounting_id, (label.get("file") for label in rows.labels), strict=True))
    return sorted({data / str(name) for name in chosen.values() if name})


def _packs(data: Path) -> Iterable[Path]:
    return find_packs(data)


def _facts(path: Path) -> BenchFacts | None:
    """Return what a pack or an episode file says of its bench, None if it says nothing."""
    try:
        records = read_first(path).metadata
    except InputError:
        # Its signals were read already, or come from the cache: only the origin stays untold.
        return None
    settings = records.get("pack", {}).get("settings")
    facts = records.get("bench", {}).get("facts")
    try:
        if settings is not None:
            return simulated_facts(SimulationSettings.model_validate_json(settings))
        return None if facts is None else BenchFacts.model_validate_json(facts)
    except ValidationError:
        return None
