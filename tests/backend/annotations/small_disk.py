"""Label and collect on a disk that really fills up: ``python -m`` this module FOLDER (on it).

Prints one JSON object: what was acknowledged, what is not there afterwards, and how it was told.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

from tests.backend.annotations.conftest import context_for, small_episode
from tests.backend.bench.brisk import brisk_bench, brisk_method
from touchdown.backend.annotations import Dataset, Label, check_dataset, storage
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core import Event, FaultError, Paused, ProbeCollected, RunFinished
from touchdown.backend.runs import CollectRequest, RecordingOptions

MOST = 4000  # more labels than fit into the free space
LEFT_BYTES = 60_000


def fill(ballast: Path, left_bytes: int) -> None:
    """Fill a disk up to ``left_bytes``."""
    free = shutil.disk_usage(ballast.parent).free - left_bytes
    with ballast.open("wb") as file:
        file.write(bytes(max(free, 0)))


def label_until_full(folder: Path) -> dict[str, object]:
    """Label, then record, until the disk is full; free space, continue, and check all data."""
    home, ballast = folder / "labels", folder / "ballast"
    kept: dict[str, tuple[str, int]] = {}
    codes: list[str] = []
    with Dataset.open(home, person="ann") as dataset:
        context = context_for(dataset)

        def record(seed: int) -> str:
            label = Label(seed, 0, 0, 9)
            episode = small_episode(seed=seed)
            return dataset.record(episode, label, source="commanded", context=context).uuid

        def label(uuid: str, x_um: int) -> None:
            revision = dataset.labels.set("ann", uuid, Label(x_um, 0, 0, 9))
            kept[revision.rev_uuid] = (uuid, x_um)

        uuid = record(1)
        fill(ballast, LEFT_BYTES)
        try:
            for x_um in range(MOST):
                label(uuid, 10 + x_um)
        except FaultError as error:
            codes.append(error.fault.code)
        full = len(kept)
        try:
            record(2)
        except FaultError as error:
            codes.append(error.fault.code)
        left = len(dataset.episodes())
        ballast.unlink()
        label(uuid, 1)
        label(record(3), 2)
    with Dataset.open(home, person="ann") as dataset:
        found = {
            r.rev_uuid: (uuid, r.label.x_um)
            for uuid in {uuid for uuid, _ in kept.values()}
            for r in dataset.labels.history(uuid)
        }
        wrong = [finding.message for finding in check_dataset(dataset.parts, whole=True)]
        lost = [rev for rev, said in kept.items() if found.get(rev) != said]
        journal = dataset.journal.path(dataset.description.site).read_text().count("\n")
        (operations,) = dataset.database.one("SELECT count(*) FROM op")
        states = [entry.file_state for entry in dataset.episodes()]
    return {
        "codes": codes, "until_full": full, "episodes_when_full": left, "lost": lost,
        "wrong": wrong, "states": states, "journal": journal, "operations": operations,
    }  # fmt: skip


def collect_until_full(folder: Path) -> dict[str, object]:
    """Collect three probes; after the first one the disk is full until the run pauses."""
    storage.LEAST_BYTES = storage.LEAST_BYTES_RUNNING = 0
    ballast, facts = folder / "ballast", list[Event]()
    stored_when_paused: list[int] = []
    session = simulated_session(
        brisk_bench("quiet"), keep=RecordingOptions(None), method=brisk_method()
    )
    with Dataset.open(folder / "collected", person="ann") as dataset:

        def watch(fact: Event) -> None:
            facts.append(fact)
            if isinstance(fact, ProbeCollected) and fact.done == 1:
                fill(ballast, LEFT_BYTES)
            elif isinstance(fact, Paused):
                stored_when_paused.append(len(dataset.episodes()))
                ballast.unlink()
                session.engine.resume()

        session.dataset = dataset
        session.events.subscribe(watch)
        session.run(CollectRequest(count=3, seed=2, person="ann", probes_per_grip=3))
        session.close()
        told = [fact.uuid for fact in facts if isinstance(fact, ProbeCollected)]
        read = [dataset.read(entry.uuid).observation.shape[0] for entry in dataset.episodes()]
        return {
            "paused": [f.fault.code for f in facts if isinstance(f, Paused) and f.fault],
            "stored_when_paused": stored_when_paused,
            "ending": [fact.ending for fact in facts if isinstance(fact, RunFinished)],
            "all_told": told == [entry.uuid for entry in dataset.episodes()],
            "ticks": read,
            "wrong": [finding.message for finding in check_dataset(dataset.parts, whole=True)],
        }


if __name__ == "__main__":
    where = Path(sys.argv[1])
    answer = {"labels": label_until_full(where), "campaign": collect_until_full(where)}
    sys.stdout.write(json.dumps(answer) + "\n")
