"""Canonical JSON and the hash chain of operations, one chain per site.

hash = SHA-256(previous hash as 32 bytes, canonical JSON of the operation without its hashes). The
chain shows that something was changed; it cannot prevent it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from hashlib import sha256

from backend.catalogue.values import Operation

FIRST = "0" * 64
"""What the first operation of a site follows."""

HASHED = ("actor", "at_ns", "body", "lamport", "op_uuid", "seq", "site", "target_op", "verb")


def canonical(value: object) -> bytes:
    """Return UTF-8 JSON with sorted keys and no spaces.

    Integers, texts, booleans, null, arrays and objects only: a float raises ``TypeError``.
    """
    _refuse_floats(value)
    return _encoded(value)


def content_hash(value: object) -> str:
    """Return the SHA-256 of the canonical JSON, in hex."""
    return sha256(canonical(value)).hexdigest()


def link(operation: Operation) -> str:
    """Return the hash that ``operation`` must carry, in hex."""
    content = {name: getattr(operation, name) for name in HASHED}
    # Without a search for floats: storing an operation refuses them, and checking 100,000 is quick.
    return sha256(bytes.fromhex(operation.prev_hash) + _encoded(content)).hexdigest()


def first_break(operations: Iterable[Operation]) -> int | None:
    """Return the sequence number of the first bad link of one site in order, or None."""
    previous, expected = FIRST, 1
    for operation in operations:
        whole = operation.seq == expected and operation.prev_hash == previous
        if not whole or link(operation) != operation.hash:
            return expected
        previous, expected = operation.hash, expected + 1
    return None


def _encoded(value: object) -> bytes:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return text.encode("utf-8")


def _refuse_floats(value: object) -> None:
    if isinstance(value, float):
        raise TypeError("a number with a fraction is never hashed: write it as text or in µm")
    if isinstance(value, dict):
        for item in value.values():
            _refuse_floats(item)
    elif isinstance(value, list | tuple):
        for item in value:
            _refuse_floats(item)
