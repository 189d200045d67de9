"""Many jobs, some of which read the results of others: in order, each once, none lost."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from backend.core.faults import InputError
from backend.jobs.executor import Executor
from backend.jobs.running import JobResult
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore


def run_campaign(
    specs: Iterable[JobSpec], executor: Executor, store: JobStore
) -> Iterator[JobResult]:
    """Yield each job as it ends: at once what is finished already, the rest in completion order.

    A job begins when those of its inputs that are jobs of the campaign are done. What depends on a
    failed job fails with it. The executor is closed at the end, also when the reader stops early.
    """
    waiting = {spec.id: spec for spec in specs}
    ahead = set(waiting)
    failed: set[str] = set()
    running = 0
    try:
        for spec in [spec for spec in waiting.values() if store.has(spec.id)]:
            del waiting[spec.id]
            ahead.discard(spec.id)
            yield JobResult(spec.id, spec.kind, "done")
        while waiting or running:
            for result in _doomed(waiting, failed):
                failed.add(result.id)
                ahead.discard(result.id)
                yield result
            for spec in _ready(waiting, ahead, executor.room()):
                del waiting[spec.id]
                executor.submit(spec)
                running += 1
            if not running:
                continue
            for result in executor.finished():
                running -= 1
                ahead.discard(result.id)
                if result.state == "failed":
                    failed.add(result.id)
                yield result
    finally:
        executor.close()


def shard_of(specs: Sequence[JobSpec], index: int, count: int) -> list[JobSpec]:
    """Return part ``index`` (from 0) of ``count``, for array schedulers.

    All ids are sorted and every ``count``-th is taken: each process finds its own part without
    talking to the others. A job whose inputs belong to another part waits for a later call.
    """
    return [spec for k, spec in enumerate(sorted(specs, key=_id)) if k % count == index]


def parse_shard(text: str) -> tuple[int, int]:
    """Return (i, n) of a text "i/n" with 0 <= i < n; raises ``InputError``."""
    index, slash, count = text.partition("/")
    if slash and index.isdecimal() and count.isdecimal() and int(index) < int(count):
        return int(index), int(count)
    raise InputError(f"'{text}' names no part.", "--shard", "Give i/n with i from 0 to n - 1.")


def startable(specs: Iterable[JobSpec], part: Iterable[JobSpec], store: JobStore) -> list[JobSpec]:
    """Return those of ``part`` that need no unfinished job outside ``part``."""
    chosen = {spec.id: spec for spec in part}
    outside = {spec.id for spec in specs if not store.has(spec.id)} - set(chosen)
    while True:
        blocked = {k for k, spec in chosen.items() if outside & set(spec.inputs)}
        if not blocked:
            return list(chosen.values())
        outside |= blocked
        chosen = {k: spec for k, spec in chosen.items() if k not in blocked}


def _id(spec: JobSpec) -> str:
    return spec.id


def _ready(waiting: dict[str, JobSpec], ahead: set[str], room: int) -> list[JobSpec]:
    ready = [spec for spec in waiting.values() if not ahead & set(spec.inputs)]
    return ready[: max(room, 0)]


def _doomed(waiting: dict[str, JobSpec], failed: set[str]) -> Iterator[JobResult]:
    for spec in list(waiting.values()):
        cause = failed & set(spec.inputs)
        if cause:
            del waiting[spec.id]
            why = f"It needs the failed job {min(cause)}."
            yield JobResult(spec.id, spec.kind, "failed", error=why)
