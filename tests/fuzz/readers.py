"""Decoders without published vectors of a stream: answers, pages, names, pictures of cameras."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from tests.backend.devices.codecs.codecs import Codec
from tests.backend.devices.codecs.vectors import VECTORS
from touchdown.backend.devices.cameras import frames
from touchdown.backend.devices.dynpick import protocol
from touchdown.backend.devices.gelsight import driver
from touchdown.backend.devices.melfa import r3_protocol
from touchdown.backend.devices.netft import protocol as net_ft

PAGE = (
    b"<netft><scfgfu>N</scfgfu><scfgtu>N-m</scfgtu><cfgcpf>1000000</cfgcpf>"
    b"<cfgcpt>1000000</cfgcpt></netft>"
)


@dataclass(frozen=True)
class Reader:
    codec: Codec
    seeds: tuple[bytes, ...]


def _vectors(*starts: str) -> tuple[bytes, ...]:
    return tuple(bytes.fromhex(v["hex"]) for n, v in VECTORS.items() if n.startswith(starts))


def _answer(read: Callable[[str], Any]) -> Reader:
    answers = tuple(
        bytes.fromhex(v["hex"])[3:]
        for v in VECTORS.values()
        if v["device"] == "melfa-r3" and v["direction"] == "device-to-pc"
    )
    return Reader(Codec(None, datagram=lambda data: read(data.decode("latin-1"))), answers)


def _plain(read: Callable[[bytes], Any], *seeds: bytes) -> Reader:
    return Reader(Codec(None, datagram=read), seeds)


def _picture(seed: int) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", noise)[1].tobytes()


_PICTURES = tuple(_picture(seed) for seed in range(3))
_R3 = (
    r3_protocol.read_opened,
    r3_protocol.read_state,
    r3_protocol.read_error,
    r3_protocol.read_parameter,
    r3_protocol.read_axes,
)
READERS: dict[tuple[str, str], Reader] = {
    **{("r3-answer", read.__name__): _answer(read) for read in _R3},
    ("dynpick-answer", "sensitivity"): _plain(
        protocol.decode_sensitivity, *_vectors("dynpick-sensitivity-reply")
    ),
    ("netft-answer", "calibration"): _plain(
        net_ft.decode_calibration, *_vectors("netft-tcp-calibration-reply")
    ),
    ("netft-answer", "page"): _plain(net_ft.decode_page, PAGE),
    ("gelsight-mini", "name"): _plain(driver.read_serial, *_vectors("gelsight")),
    ("gelsight-mini", "pictures"): Reader(
        Codec(lambda picture: picture, stream=frames.JpegStream), _PICTURES
    ),
    ("gelsight-mini", "size"): _plain(frames.size_px, *_PICTURES),
}
