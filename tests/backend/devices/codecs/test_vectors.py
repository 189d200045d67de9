"""Every published vector both ways: bytes to the documented fields, and back to the same bytes."""

import pytest

from tests.backend.devices.codecs import facts
from tests.backend.devices.codecs.codecs import CODECS, IN, OUT
from tests.backend.devices.codecs.vectors import VECTORS, data, only, same
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.dynpick import protocol as dynpick
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.gelsight import driver
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.melfa import realtime_protocol
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.wsg import protocol as wsg_binary

FACTS = {
    ("melfa-mxt", OUT): facts.mxt_request,
    ("melfa-mxt", IN): facts.mxt_reply,
    ("melfa-monitor", OUT): facts.monitor_request,
    ("melfa-monitor", IN): facts.monitor_reply,
    ("melfa-r3", OUT): facts.r3_request,
    ("melfa-r3", IN): facts.r3_reply,
    ("wsg-binary", OUT): facts.wsg_request,
    ("wsg-binary", IN): facts.wsg_reply,
    ("wsg-gcl", OUT): facts.gcl,
    ("wsg-gcl", IN): facts.gcl,
    ("dynpick", OUT): lambda message, vector: {"command": message.value.decode()},
    ("dynpick", IN): facts.dynpick_record,
    ("leptrino", OUT): facts.leptrino_packet,
    ("leptrino", IN): facts.leptrino_packet,
    ("robotiq-ft300", OUT): facts.ft300,
    ("robotiq-ft300", IN): facts.ft300,
    ("bota", OUT): facts.bota_message,
    ("bota", IN): facts.bota_message,
    ("optoforce", OUT): facts.optoforce_message,
    ("optoforce", IN): facts.optoforce_message,
    ("netft", OUT): facts.rdt_request,
    ("netft", IN): facts.rdt_record,
}

ALONE = {
    "dynpick-sensitivity-reply",
    "dynpick-temperature-reply",
    "dynpick-filter-reply",
    "netft-tcp-read-calibration",
    "netft-tcp-calibration-reply",
    "gelsight-card-name",
    "gelsight-card-name-other",
    "gelsight-card-name-second",
    "ft300-vendor-crc-1",
    "ft300-vendor-crc-2",
}
"""Answers outside the stream, texts that are only read, and two that check the CRC alone."""

GOOD = [n for n, v in VECTORS.items() if v["valid"] and "kind" not in v and n not in ALONE]
BAD = [n for n, v in VECTORS.items() if not v["valid"]]
STREAMS = [n for n, v in VECTORS.items() if v.get("kind") == "stream"]


def codec(name):
    vector = VECTORS[name]
    return CODECS[vector["device"], vector["direction"]]


def decoded(name):
    its, content = codec(name), data(name)
    if its.datagram is not None:
        return its.datagram(content)
    return only(its.stream(), content + its.end)


def test_the_file_is_whole():
    assert len(VECTORS) == 243
    assert (len(GOOD), len(BAD), len(STREAMS), len(ALONE)) == (220, 11, 2, 10)


@pytest.mark.parametrize("name", GOOD)
def test_bytes_become_the_documented_fields(name):
    vector = VECTORS[name]
    found = FACTS[vector["device"], vector["direction"]](decoded(name), vector)
    assert same(vector["fields"], found), (vector["fields"], found)


@pytest.mark.parametrize("name", GOOD)
def test_the_message_becomes_the_same_bytes(name):
    assert codec(name).encode(decoded(name)) == data(name)


@pytest.mark.parametrize("name", [n for n in GOOD if CODECS[VECTORS[n]["device"], OUT].stream])
def test_byte_by_byte_gives_the_same(name):
    its = codec(name)
    assert its.messages(data(name) + its.end, cut=1) == [decoded(name)]


@pytest.mark.parametrize("name", BAD)
def test_what_is_marked_invalid_is_refused(name):
    its = codec(name)
    assert its.messages(data(name)) == []
    if its.stream is not None:
        decoder = its.stream()
        decoder.feed(data(name))
        assert decoder.bad_frames == 1


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("cut", [None, 1, 7])
def test_a_stream_with_noise_gives_exactly_the_listed_messages(name, cut):
    wanted = [decoded(frame) for frame in VECTORS[name]["fields"]["frames"]]
    assert codec(name).messages(data(name), cut) == wanted


def test_answers_outside_the_stream():
    sensitivity = (65.47, 65.44, 65.08, 1638.5, 1639.25, 1640.75)
    assert dynpick.decode_sensitivity(data("dynpick-sensitivity-reply")) == sensitivity
    assert dynpick.encode_sensitivity(sensitivity) == data("dynpick-sensitivity-reply")
    assert dynpick.decode_temperature(data("dynpick-temperature-reply")) == 27.5
    assert dynpick.encode_temperature(27.5) == data("dynpick-temperature-reply")
    assert dynpick.decode_filter(data("dynpick-filter-reply")) == 4
    assert dynpick.encode_filter(4) == data("dynpick-filter-reply")
    assert data("netft-tcp-read-calibration") == net_ft.TCP_REQUEST
    calibration = net_ft.decode_calibration(data("netft-tcp-calibration-reply"))
    fields = VECTORS["netft-tcp-calibration-reply"]["fields"]
    assert (calibration.counts_per_n, calibration.counts_per_nm) == (1_000_000, 1_000_000)
    assert list(calibration.scale) == fields["scale"]
    assert net_ft.encode_calibration(calibration) == data("netft-tcp-calibration-reply")


@pytest.mark.parametrize("name", [n for n in sorted(ALONE) if n.startswith("gelsight")])
def test_the_card_name_gives_the_serial(name):
    card, wanted = driver.decode(data(name)), VECTORS[name]["fields"]
    assert {"name": card.name, "is_gelsight": card.is_gelsight, "serial": card.serial} == wanted


ONE_FRAME = {
    "melfa-mxt": realtime_protocol.decode_mxt_reply,
    "wsg-binary": wsg_binary.decode_reply,
    "dynpick": dynpick.decode_record,
    "leptrino": leptrino.decode,
    "robotiq-ft300": robotiq_ft300.decode,
    "bota": protocol.decode_frame,
    "optoforce": optoforce.decode,
    "netft": net_ft.decode_records,
}


@pytest.mark.parametrize("name", BAD)
def test_the_reason_of_a_refusal_is_the_documented_one(name):
    with pytest.raises(ProtocolError) as refusal:
        ONE_FRAME[VECTORS[name]["device"]](data(name))
    assert refusal.value.what == VECTORS[name]["error"]
    assert 0 <= refusal.value.offset <= len(data(name))
