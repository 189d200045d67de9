"""A job by everything its result depends on: equal specs have equal results and one name."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from typing import Any, Self

ID_DIGITS = 32


@dataclass(frozen=True)
class JobSpec:
    """What to do (``kind``), with which ``params`` (JSON values) and ``seed``, on which ``inputs``.

    ``inputs``: ids of the jobs, or hashes of the files, that the job reads. ``code``: version of
    the program. None of it may be changed afterwards.
    """

    kind: str
    params: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    inputs: tuple[str, ...] = ()
    code: str = ""

    def canonical(self) -> str:
        """Return the one JSON text of this spec: keys sorted, no spaces, no NaN (ValueError)."""
        facts = {
            "kind": self.kind,
            "params": self.params,
            "seed": self.seed,
            "inputs": list(self.inputs),
            "code": self.code,
        }
        return json.dumps(facts, sort_keys=True, separators=(",", ":"), allow_nan=False)

    @cached_property
    def id(self) -> str:
        """First 32 hex digits of the SHA-256 of the canonical text."""
        return sha256(self.canonical().encode()).hexdigest()[:ID_DIGITS]

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the spec of a canonical text; raises ValueError or KeyError for anything else."""
        facts = json.loads(text)
        return cls(
            kind=str(facts["kind"]),
            params=dict(facts["params"]),
            seed=int(facts["seed"]),
            inputs=tuple(facts["inputs"]),
            code=str(facts["code"]),
        )
