"""Byte vectors of data-and-labelling 2.4, made there with an independent serialiser."""

import struct

import numpy as np
import pytest

from touchdown.backend.core.values import MARKERS
from touchdown.backend.episodes import messages
from touchdown.backend.episodes.messages import CdrReader

STAMP = np.array([1_700_000_000_123_456_789])
HEAD = "00 01 00 00 00 f1 53 65 15 cd 5b 07"


def doubles(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def test_wrench_has_the_published_bytes() -> None:
    wrench = np.array([[1, -2, 22.5, 0.01, -0.02, 0.003]])
    expected = bytes.fromhex(
        HEAD + "03 00 00 00 66 74 00 00"
        "000000000000f03f 00000000000000c0 0000000000803640"
        "7b14ae47e17a843f 7b14ae47e17a94bf fa7e6abc7493683f"
    )
    packed = messages.pack_wrench(STAMP, wrench)
    assert packed.tobytes() == expected
    assert len(expected) == 68
    assert np.array_equal(messages.unpack_wrench([packed[0].tobytes()]), wrench)
    assert messages.stamps_ns([packed[0].tobytes()]).tolist() == STAMP.tolist()


def test_pose_has_the_published_bytes() -> None:
    packed = messages.pack_pose(STAMP, np.array([[100.0, 200.0, 300.0]]))
    expected = bytes.fromhex(HEAD + "05 00 00 00 62 61 73 65 00 00 00 00 00 00 00 00")
    assert packed.tobytes() == expected + doubles(0.1, 0.2, 0.3, 0, 0, 0, 1)
    assert packed.size == 84
    assert np.allclose(messages.unpack_pose_mm([packed[0].tobytes()]), [[100, 200, 300]])


def test_image_has_the_published_bytes() -> None:
    packed = messages.pack_image(int(STAMP[0]), "tac_left", "jpeg", b"\xff\xd8\xff\xd9")
    assert packed == bytes.fromhex(
        HEAD + "09 00 00 00 74 61 63 5f 6c 65 66 74 00 00 00 00"
        "05 00 00 00 6a 70 65 67 00 00 00 00 04 00 00 00 ff d8 ff d9"
    )
    assert messages.unpack_image(packed) == ("jpeg", b"\xff\xd8\xff\xd9")


def test_text_has_the_published_bytes() -> None:
    packed = messages.pack_json({"x_mm": 1.5})
    assert packed == bytes.fromhex("00 01 00 00 0d 00 00 00 7b 22 78 5f 6d 6d 22 3a 31 2e 35 7d 00")
    assert messages.unpack_json(packed) == {"x_mm": 1.5}


def test_observation_fields_lie_where_cdr_puts_them() -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    packed = messages.pack_observation(np.array([0, 100_000_000]), values)
    second = packed[1].tobytes()
    # header 8 + "obs\0" with its length 8 = 16, step, count, floats
    assert struct.unpack_from("<II3f", second, 4 + 16) == (1, 3, 3.0, 4.0, 5.0)
    assert np.array_equal(messages.unpack_observation([m.tobytes() for m in packed]), values)


def test_observation_out_of_order_is_refused() -> None:
    packed = messages.pack_observation(np.array([0, 1]), np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="order"):
        messages.unpack_observation([packed[1].tobytes(), packed[0].tobytes()])


def test_markers_come_back_bit_for_bit_and_are_stored_axis_first() -> None:
    rng = np.random.default_rng(3)
    rows = messages.MarkerRows(
        rng.normal(size=(4, MARKERS, 2)),
        rng.normal(size=(4, MARKERS, 2)),
        rng.integers(0, 3, (4, MARKERS)).astype(np.uint8),
        rng.random(4),
        rng.random(4),
    )
    packed = messages.pack_markers(np.arange(4) * 40_000_000, rows, "tac_left")
    back = messages.unpack_markers([m.tobytes() for m in packed])
    assert np.array_equal(back.position_px, rows.position_px)
    assert np.array_equal(back.displacement_px, rows.displacement_px)
    assert np.array_equal(back.state, rows.state)
    assert np.array_equal(back.quality, rows.quality)
    assert np.array_equal(back.residual_px, rows.residual_px)
    reader = CdrReader(packed[2].tobytes())
    assert reader.header() == (80_000_000, "tac_left")
    assert (reader.integer("H"), reader.integer("H")) == (7, 9)
    first = reader.sequence("<f8")
    assert np.array_equal(first[:MARKERS], rows.displacement_px[2, :, 0])


@pytest.mark.parametrize("cut", [0, 3, 7, 15, 30])
def test_a_message_cut_short_is_refused(cut: int) -> None:
    packed = messages.pack_image(0, "tac_left", "jpeg", b"12345678")
    with pytest.raises(ValueError, match=r"CDR|shorter"):
        messages.unpack_image(packed[:cut])
