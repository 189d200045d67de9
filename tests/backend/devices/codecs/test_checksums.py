"""Checksums against catalogue check values, the standard library and a bitwise definition."""

import binascii

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.backend.devices.codecs.vectors import CONTENT, VECTORS, data
from touchdown.backend.devices import framing

CHECKS = CONTENT["checks"]


def reflected(polynomial, content, final):
    """CRC bit by bit, least significant first: the definition, without a table."""
    register = 0xFFFF
    for byte in content:
        for bit in range(8):
            odd = (register ^ byte >> bit) & 1
            register = register >> 1 ^ (polynomial if odd else 0)
    return register ^ final


def test_published_check_values():
    assert framing.crc16_x25(b"123456789") == 0x906E == CHECKS["crc16_x25_of_123456789"]
    assert framing.crc16_modbus(b"123456789") == 0x4B37 == CHECKS["crc16_modbus_of_123456789"]
    assert framing.crc_wsg(b"\xaa\xaa\xaa") == 0x50F5 == CHECKS["wsg_crc_of_preamble"]
    assert list(framing.WSG_TABLE[:8]) == CHECKS["wsg_table_first8"]


def test_the_wsg_table_is_that_of_the_standard_library():
    assert list(framing.WSG_TABLE) == [binascii.crc_hqx(bytes([i]), 0) for i in range(256)]


@given(st.binary(max_size=80))
def test_table_and_definition_agree(content):
    assert framing.crc16_x25(content) == reflected(0x8408, content, 0xFFFF)
    assert framing.crc16_modbus(content) == reflected(0xA001, content, 0)


@given(st.binary(max_size=80))
def test_a_wsg_frame_with_its_crc_gives_zero(content):
    crc = framing.crc_wsg(content)
    assert framing.crc_wsg(content + crc.to_bytes(2, "little")) == 0


def test_zero_over_a_wsg_frame_does_not_prove_it_whole():
    zeros = [
        end
        for end in range(0x10000)
        if framing.crc_wsg(b"\xaa\xaa\xaa\x22\x00\x00" + end.to_bytes(2, "little")) == 0
    ]
    assert 0x760E in zeros
    assert len(zeros) > 1


@pytest.mark.parametrize("name", [name for name in VECTORS if name.startswith("ft300-vendor")])
def test_frames_printed_by_the_maker_carry_this_crc(name):
    *body, low, high = data(name)
    assert framing.crc16_modbus(bytes(body)) == low | high << 8


@given(st.binary(min_size=1, max_size=40), st.integers(0))
def test_sum_and_exclusive_or_see_any_one_flipped_bit(content, place):
    at, bit = divmod(place % (8 * len(content)), 8)
    flipped = bytearray(content)
    flipped[at] ^= 1 << bit
    assert framing.sum16(bytes(flipped)) != framing.sum16(content)
    assert framing.xor8(bytes(flipped)) != framing.xor8(content)
