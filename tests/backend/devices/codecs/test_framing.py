"""Checksums, decoders and published byte vectors of all protocols."""

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.backend.devices.codecs.codecs import CODECS
from tests.backend.devices.codecs.facts import facts
from tests.backend.devices.codecs.messages import MESSAGES
from tests.backend.devices.codecs.vectors import CONTENT, VECTORS, data, only, same
from touchdown.backend.devices import framing
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

CHECKS = CONTENT["checks"]


def test_published_check_values():
    assert framing.crc16_x25(b"123456789") == 0x906E == CHECKS["crc16_x25_of_123456789"]
    assert framing.crc16_modbus(b"123456789") == 0x4B37 == CHECKS["crc16_modbus_of_123456789"]
    assert framing.crc_wsg(b"\xaa\xaa\xaa") == 0x50F5 == CHECKS["wsg_crc_of_preamble"]
    assert list(framing.WSG_TABLE[:8]) == CHECKS["wsg_table_first8"]


@pytest.mark.parametrize("name", [name for name in VECTORS if name.startswith("ft300-vendor")])
def test_frames_printed_by_the_maker_carry_this_crc(name):
    *body, low, high = data(name)
    assert framing.crc16_modbus(bytes(body)) == low | high << 8


GOOD = "320411F7D1D5520A41EB82052\r\n"


def test_a_dynpick_field_above_14_bits_is_refused():
    with pytest.raises(ProtocolError, match=r"^range "):
        dynpick.decode_record(b"04000" + b"2000" * 5 + b"\r\n")


def test_a_dynpick_record_with_a_digit_too_many_is_not_read_from_its_end():
    decoder = dynpick.records()
    out = decoder.feed(b"3" + GOOD.encode() + GOOD.encode())
    assert [record.tick for record in out] == [3]
    assert decoder.bad_frames == 1


def test_dynpick_noise_without_line_ends_is_given_up():
    decoder = dynpick.records()
    assert decoder.feed(b"7" * 5000) == []
    assert decoder.pending <= 2 * dynpick.RECORD_BYTES
    assert len(decoder.feed(b"\r\n" + GOOD.encode())) == 1


@pytest.mark.parametrize("text", [b"0,0,0,0,0,0\r\n", b"65.470,65.440\r\n", b"1,1,1,1,1,nan\r\n"])
def test_a_dynpick_without_sensitivity_is_not_divided_by(text):
    with pytest.raises(ProtocolError):
        dynpick.decode_sensitivity(text)


def test_a_lost_leptrino_frame_takes_only_itself():
    whole = data("leptrino-data-fake-etx")
    decoder = leptrino.packets()
    out = decoder.feed(whole[:9] + data("leptrino-data") + whole)
    assert [p.counts[0] for p in out] == [1000, 784]
    assert decoder.bad_frames == 1


def test_a_leptrino_rated_load_of_zero_is_refused():
    frame = leptrino.encode(leptrino.RatedLoads((0.0,) * 6))
    with pytest.raises(ProtocolError):
        leptrino.decode(frame)


def test_ft300_short_stop_is_no_stop():
    decoder = robotiq_ft300.requests()
    assert decoder.feed(b"\xff" * 49 + data("ft300-read-wrench")) == [
        robotiq_ft300.ReadRegisters(180, 6)
    ]
    assert decoder.feed(b"\xff" * 30) == []
    assert decoder.feed(b"\xff" * 20) == [robotiq_ft300.StreamStop()]


def test_bota_marked_values_are_never_handed_on():
    (frame,) = protocol.incoming().feed(data("bota-frame-invalid"))
    assert all(math.isnan(value) for part in frame.wrench() for value in part)
    (over,) = protocol.incoming().feed(data("bota-frame-overrange"))
    assert over.status & protocol.BotaStatus.OVER_RANGE
    assert over.wrench().force_n[0] == 600.0


def test_bota_nan_counts_as_bad_unless_marked():
    values = (math.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    decoder = protocol.incoming()
    assert decoder.feed(protocol.encode(protocol.BotaFrame(0, values, 1, 20.0))) == []
    assert decoder.bad_frames > 0
    (frame,) = protocol.incoming().feed(protocol.encode(protocol.BotaFrame(4, values, 1, 20.0)))
    assert math.isnan(frame.values[0])


def test_a_bota_answer_behind_a_frame_that_it_cut_off():
    decoder = protocol.incoming()
    assert decoder.feed(data("bota-frame")[:20]) == []
    assert decoder.feed(b"r,0,C") == []
    assert decoder.feed(b",0") == [protocol.BotaReply("C", 0)]


def test_optoforce_scale_needs_as_many_numbers_as_axes():
    (frame,) = optoforce.incoming().feed(data("optoforce-frame22"))
    wrench = frame.wrench((1000.0,) * 6, (200.0, 200.0, 400.0, 10.0, 10.0, 10.0))
    assert wrench.force_n == pytest.approx((20.0, -40.0, -420.0))
    assert wrench.torque_nm == pytest.approx((0.1, -0.2, 0.05))
    with pytest.raises(ValueError, match="zip"):
        frame.wrench((1000.0,) * 3, (200.0,) * 3)


@pytest.mark.parametrize("code", [-1, 256])
def test_an_optoforce_code_that_is_no_byte_is_refused(code):
    with pytest.raises(ProtocolError):
        optoforce.encode(optoforce.OptoforceConfig(code, 0))


PAGE = "<a><scfgfu>{}</scfgfu><scfgtu>{}</scfgtu><cfgcpf>{}</cfgcpf><cfgcpt>{}</cfgcpt></a>"


def test_the_page_of_a_net_box():
    page = PAGE.format("N", "N-m", "1000000", "50000").encode()
    assert net_ft.decode_page(page) == (1_000_000.0, 50_000.0)


@pytest.mark.parametrize(
    ("fields", "what"),
    [
        (("lbf", "N-m", "1", "1"), "unit"),
        (("N", "lbf-in", "1", "1"), "unit"),
        (("N", "N-m", "0", "1"), "range"),
        (("N", "N-m", "inf", "1"), "range"),
        (("N", "N-m", "many", "1"), "number"),
    ],
)
def test_a_page_in_other_units_is_refused(fields, what):
    with pytest.raises(ProtocolError, match=f"^{what} "):
        net_ft.decode_page(PAGE.format(*fields).encode())


def test_a_page_without_a_field_names_it():
    with pytest.raises(ProtocolError, match="cfgcpf"):
        net_ft.decode_page(b"<scfgfu>N</scfgfu><scfgtu>N-m</scfgtu>")


def test_a_calibration_in_pounds_is_refused():
    content = bytearray(data("netft-tcp-calibration-reply"))
    content[2] = 1
    with pytest.raises(ProtocolError, match=r"^unit "):
        net_ft.decode_calibration(bytes(content))


ALL = sorted(CODECS)
STREAMS = [key for key in ALL if CODECS[key].stream]
TEXTS = {("dynpick", "pc-to-device"), ("bota", "pc-to-device")}
"""Commands of single letters, which noise can spell."""
SUMMED = {"wsg-binary", "robotiq-ft300", "bota", "optoforce"}
CHECKED = [key for key in STREAMS if key[0] in SUMMED and key not in TEXTS]
"""Streams with a checksum of 16 bits: what comes out was sent."""
FRAMED = [key for key in STREAMS if key not in TEXTS]

few = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
by_key = pytest.mark.parametrize("key", ALL, ids="/".join)
by_stream = pytest.mark.parametrize("key", STREAMS, ids="/".join)


def encoded(codec, messages):
    return [codec.encode(message) + extra(codec, message) for message in messages]


def extra(codec, message):
    content = codec.encode(message)
    return codec.end if codec.end and not content.endswith(b"\n") else b""


def is_subsequence(part, whole):
    rest = iter(whole)
    return all(any(item == other for other in rest) for item in part)


@by_key
@few
@given(data=st.data())
def test_every_message_comes_back(key, data):
    codec = CODECS[key]
    message = data.draw(MESSAGES[key])
    (frame,) = encoded(codec, [message])
    assert codec.messages(frame) == [message]


@pytest.mark.promise("S1")
@by_stream
@few
@given(data=st.data())
def test_where_the_stream_is_cut_does_not_matter(key, data):
    codec = CODECS[key]
    messages = data.draw(st.lists(MESSAGES[key], max_size=5))
    content = b"".join(encoded(codec, messages))
    decoder, out = codec.stream(), []
    while content:
        cut = data.draw(st.integers(1, len(content)))
        out += decoder.feed(content[:cut])
        content = content[cut:]
    assert out == messages
    assert decoder.bad_frames == decoder.discarded == decoder.pending == 0


@pytest.mark.promise("S1")
@pytest.mark.parametrize("key", FRAMED, ids="/".join)
@few
@given(data=st.data())
def test_after_noise_the_third_frame_at_the_latest_is_read(key, data):
    codec = CODECS[key]
    noise = data.draw(st.binary(max_size=60))
    messages = data.draw(st.lists(MESSAGES[key], min_size=3, max_size=6))
    content = b"".join([noise, *encoded(codec, messages)])
    out = codec.messages(content)
    assert out[len(out) - len(messages) + 2 :] == messages[2:]
    assert codec.messages(content, cut=data.draw(st.sampled_from((1, 7, 64)))) == out


@pytest.mark.parametrize("key", FRAMED, ids="/".join)
@few
@given(data=st.data())
def test_after_a_frame_cut_short_the_third_is_read(key, data):
    codec = CODECS[key]
    first, *messages = data.draw(st.lists(MESSAGES[key], min_size=4, max_size=6))
    frame, *frames = encoded(codec, [first, *messages])
    decoder = codec.stream()
    decoder.feed(frame[: data.draw(st.integers(1, len(frame)))])
    out = [m for following in frames for m in decoder.feed(following)]
    assert out[len(out) - len(messages) + 2 :] == messages[2:]


@pytest.mark.promise("S3")
@pytest.mark.parametrize("key", CHECKED, ids="/".join)
@few
@given(data=st.data())
def test_one_flipped_bit_never_makes_a_message(key, data):
    codec = CODECS[key]
    messages = data.draw(st.lists(MESSAGES[key], min_size=1, max_size=4))
    content = bytearray(b"".join(encoded(codec, messages)))
    place = data.draw(st.integers(0, 8 * len(content) - 1))
    content[place // 8] ^= 1 << place % 8
    out = [
        m
        for m in codec.messages(bytes(content))
        if type(m).__name__ not in ("WsgRefusal", "ModbusRefusal", "StreamStop")
    ]
    assert is_subsequence(out, messages)


@pytest.mark.parametrize("key", [key for key in ALL if key not in STREAMS], ids="/".join)
@few
@given(data=st.data())
def test_a_datagram_of_another_length_is_refused(key, data):
    codec = CODECS[key]
    frame = codec.encode(data.draw(MESSAGES[key]))
    short = data.draw(st.integers(0, len(frame) - 1).filter(lambda n: n == 0 or n % 36))
    assert codec.messages(frame[:short]) == []
    assert codec.messages(frame + b"\x00") == []


@by_key
@few
@given(content=st.binary(max_size=400))
def test_noise_never_raises(key, content):
    CODECS[key].messages(content)
    CODECS[key].messages(content, cut=3)


@pytest.mark.promise("S1")
@by_stream
@few
@given(content=st.binary(max_size=3000))
def test_what_is_kept_of_noise_stays_small(key, content):
    decoder = CODECS[key].stream()
    for at in range(0, len(content), 50):
        decoder.feed(content[at : at + 50])
    assert decoder.pending <= (4096 if key[0] == "melfa-r3" else 330)
    decoder.reset()
    assert decoder.pending == 0


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

VECTORS_GOOD = [n for n, v in VECTORS.items() if v["valid"] and "kind" not in v and n not in ALONE]
BAD = [n for n, v in VECTORS.items() if not v["valid"]]
VECTORS_STREAMS = [n for n, v in VECTORS.items() if v.get("kind") == "stream"]


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
    assert (len(VECTORS_GOOD), len(BAD), len(VECTORS_STREAMS), len(ALONE)) == (220, 11, 2, 10)


@pytest.mark.parametrize("name", VECTORS_GOOD)
def test_bytes_become_the_documented_fields_and_the_same_bytes_again(name):
    vector = VECTORS[name]
    found = facts(decoded(name), vector)
    assert same(vector["fields"], found), (vector["fields"], found)
    its = codec(name)
    assert its.encode(decoded(name)) == data(name)
    if its.stream is not None:
        assert its.messages(data(name) + its.end, cut=1) == [decoded(name)]


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
def test_what_is_marked_invalid_is_refused_for_the_documented_reason(name):
    with pytest.raises(ProtocolError) as refusal:
        ONE_FRAME[VECTORS[name]["device"]](data(name))
    assert refusal.value.what == VECTORS[name]["error"]
    assert 0 <= refusal.value.offset <= len(data(name))
    its = codec(name)
    assert its.messages(data(name)) == []
    if its.stream is not None:
        decoder = its.stream()
        decoder.feed(data(name))
        assert decoder.bad_frames == 1


@pytest.mark.parametrize("name", VECTORS_STREAMS)
@pytest.mark.parametrize("cut", [None, 1, 7])
def test_a_stream_with_noise_gives_exactly_the_listed_messages(name, cut):
    wanted = [decoded(frame) for frame in VECTORS[name]["fields"]["frames"]]
    assert codec(name).messages(data(name), cut) == wanted


def test_answers_outside_the_stream():
    sensitivity = (65.47, 65.44, 65.08, 1638.5, 1639.25, 1640.75)
    assert dynpick.decode_sensitivity(data("dynpick-sensitivity-reply")) == sensitivity
    assert dynpick.encode_sensitivity(sensitivity) == data("dynpick-sensitivity-reply")
    assert dynpick.encode_temperature(27.5) == data("dynpick-temperature-reply")
    assert dynpick.encode_filter(4) == data("dynpick-filter-reply")
    assert data("netft-tcp-read-calibration") == net_ft.TCP_REQUEST
    calibration = net_ft.decode_calibration(data("netft-tcp-calibration-reply"))
    fields = VECTORS["netft-tcp-calibration-reply"]["fields"]
    assert (calibration.counts_per_n, calibration.counts_per_nm) == (1_000_000, 1_000_000)
    assert list(calibration.scale) == fields["scale"]
    assert net_ft.encode_calibration(calibration) == data("netft-tcp-calibration-reply")


@pytest.mark.parametrize("name", [n for n in sorted(ALONE) if n.startswith("gelsight")])
def test_the_card_name_gives_the_serial(name):
    assert driver.read_serial(data(name)) == VECTORS[name]["fields"]["serial"]
