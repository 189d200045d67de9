"""Hashes and ids compared with published vectors."""

from __future__ import annotations

import json

import pytest

from touchdown.backend.annotations.values import FIRST_HASH as VALUES_FIRST_HASH
from touchdown.backend.annotations.values import (
    Operation,
    canonical_json,
    content_hash,
    first_broken_link,
    is_uuid7,
    operation_hash,
    uuid7,
    uuid7_from_parts,
)

FIRST_OP = (
    '{"actor":"ann","at_ns":1700000000000000000,"body":{"closes":[],"revs":[{"episode":"ep-1",'
    '"geometry":"g-1","note":"","parent":null,"reason":null,"rev_uuid":"r-1","sigma_um":100,'
    '"source":"human","state":"submitted","theta_mdeg":0,"verdict":null,"x_um":1500,"y_um":-250}]},'
    '"lamport":1,"op_uuid":"op-1","seq":1,"site":"A","target_op":null,"verb":"label.set"}'
)
FIRST_HASH = "7e024c3b923a4d1ed09b5c8498dd87d881f8eb8de319dfd8d0de98a3d8bff805"
SECOND_OP = (
    '{"actor":"ann","at_ns":1700000001000000000,"body":{"closes":[],"revs":[{"episode":"ep-1",'
    '"geometry":"g-1","note":"","parent":"r-1","reason":null,"rev_uuid":"r-2","sigma_um":null,'
    '"source":"human","state":"unlabelled","theta_mdeg":null,"verdict":null,"x_um":null,'
    '"y_um":null}]},"lamport":2,"op_uuid":"op-2","seq":2,"site":"A","target_op":"op-1",'
    '"verb":"undo"}'
)
SECOND_HASH = "e8f53d2ec1936ec7559812cb81acbaef03cbb919d28e44b2a3166b1ffc6c712d"


def operation(text: str, prev_hash: str, digest: str) -> Operation:
    return Operation(**json.loads(text), prev_hash=prev_hash, hash=digest)


def test_both_links_of_the_published_chain() -> None:
    first = operation(FIRST_OP, VALUES_FIRST_HASH, FIRST_HASH)
    second = operation(SECOND_OP, FIRST_HASH, SECOND_HASH)
    assert canonical_json(json.loads(FIRST_OP)) == FIRST_OP.encode()
    assert len(FIRST_OP.encode()) == 354
    assert operation_hash(first) == FIRST_HASH
    assert operation_hash(second) == SECOND_HASH
    assert first_broken_link([first, second]) is None


def test_one_changed_character_is_found_and_located() -> None:
    first = operation(FIRST_OP, VALUES_FIRST_HASH, FIRST_HASH)
    changed = operation(SECOND_OP.replace('"undo"', '"Undo"'), FIRST_HASH, SECOND_HASH)
    assert first_broken_link([first, changed]) == 2
    assert first_broken_link([changed]) == 1


def test_a_float_is_never_hashed_and_words_stay_as_they_are() -> None:
    with pytest.raises(TypeError):
        canonical_json({"x": [1, {"y": 0.5}]})
    assert canonical_json({"b": "Jörg", "a": None}) == '{"a":null,"b":"Jörg"}'.encode()


def test_the_published_face_record() -> None:
    face = {"com_um": [0, 0], "d_um": 15000, "kind": "face", "shape": "circle", "v": 1}
    expected = "1e539dbc6c5b2a1e36adca9ca8496f7049f62f099342ac2d4a8439cee539303b"
    assert content_hash(face) == expected


def test_ids_sort_by_time_and_have_the_form_of_rfc_9562() -> None:
    # Appendix A.6 of RFC 9562.
    random = (0xCC3 << 62) | 0x18C4DC0C0C07398F
    assert uuid7_from_parts(0x017F22E279B0, random) == "017f22e2-79b0-7cc3-98c4-dc0c0c07398f"
    made = [uuid7() for _ in range(3000)]
    assert made == sorted(made)
    assert len(set(made)) == 3000
    assert all(map(is_uuid7, made))
    assert not is_uuid7("0190-abc")
    assert not is_uuid7("6ba7b810-9dad-41d1-80b4-00c04fd430c8")
