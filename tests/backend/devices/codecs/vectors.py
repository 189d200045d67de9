"""The published byte vectors, and how a decoder is fed for them."""

import json
import math
from pathlib import Path

FILE = Path(__file__).resolve().parents[3] / "data" / "protocol-vectors.json"
CONTENT = json.loads(FILE.read_text("utf-8"))
VECTORS = {vector["name"]: vector for vector in CONTENT["vectors"]}


def data(name):
    return bytes.fromhex(VECTORS[name]["hex"])


def only(decoder, content):
    """The one message of ``content``; fed byte by byte nothing may differ."""
    (message,) = decoder.feed(content)
    assert decoder.bad_frames == decoder.discarded == decoder.pending == 0
    return message


def same(wanted, found):
    """True if two values of fields agree: numbers within 1e-9 relative, the rest exactly."""
    if isinstance(wanted, dict):
        return set(wanted) <= set(found) and all(same(wanted[k], found[k]) for k in wanted)
    if isinstance(wanted, list | tuple):
        return len(wanted) == len(found) and all(map(same, wanted, found))
    if isinstance(wanted, float) or (isinstance(found, float) and not isinstance(wanted, bool)):
        return math.isclose(wanted, found, rel_tol=1e-9, abs_tol=1e-12)
    return wanted == found
