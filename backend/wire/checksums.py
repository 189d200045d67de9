"""The checksums of every protocol.

Check values over ``123456789``: X-25 906E, MODBUS 4B37 (catalogue of R. Williams and G. Cook).
"""

from __future__ import annotations

from functools import reduce
from operator import xor


def _table(polynomial: int, reflected: bool) -> tuple[int, ...]:
    def entry(index: int) -> int:
        crc = index if reflected else index << 8
        for _ in range(8):
            if reflected:
                crc = crc >> 1 ^ (polynomial if crc & 1 else 0)
            else:
                crc = (crc << 1 ^ (polynomial if crc & 0x8000 else 0)) & 0xFFFF
        return crc

    return tuple(entry(index) for index in range(256))


WSG_TABLE = _table(0x1021, reflected=False)
_X25_TABLE = _table(0x8408, reflected=True)
_MODBUS_TABLE = _table(0xA001, reflected=True)


def _crc16(table: tuple[int, ...], data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 0xFF] ^ crc >> 8
    return crc


def crc_wsg(data: bytes) -> int:
    """CRC of Weiss grippers, from the preamble on.

    In no catalogue: the table is the one of the unreflected polynomial, the update the one of the
    reflected form. Source: command set reference manual, firmware 2.2.0.
    """
    return _crc16(WSG_TABLE, data)


def crc16_x25(data: bytes) -> int:
    """CRC-16/X-25: polynomial 1021 reflected, start FFFF, final exclusive or FFFF."""
    return _crc16(_X25_TABLE, data) ^ 0xFFFF


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 8005 reflected, start FFFF; sent low byte first."""
    return _crc16(_MODBUS_TABLE, data)


def sum16(data: bytes) -> int:
    """Sum of all bytes, 16 bits."""
    return sum(data) & 0xFFFF


def xor8(data: bytes) -> int:
    """Exclusive or of all bytes."""
    return reduce(xor, data, 0)
