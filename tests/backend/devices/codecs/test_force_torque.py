"""What each force/torque codec does beyond its vectors: units, faults, traps of its framing."""

import math

import pytest

from tests.backend.devices.codecs.vectors import VECTORS, data
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.dynpick import protocol as dynpick
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.optoforce import protocol as optoforce

GOOD = "320411F7D1D5520A41EB82052\r\n"


def test_a_dynpick_field_above_14_bits_is_refused():
    with pytest.raises(ProtocolError) as refusal:
        dynpick.decode_record(b"04000" + b"2000" * 5 + b"\r\n")
    assert refusal.value.what == "range"


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


def test_a_leptrino_sensor_that_refuses_says_why():
    (packet,) = leptrino.packets().feed(data("leptrino-undefined"))
    assert packet == leptrino.PlainFrame(0x55, code=2)


def test_a_leptrino_rated_load_of_zero_is_refused():
    frame = leptrino.encode(leptrino.RatedLoads((0.0,) * 6))
    with pytest.raises(ProtocolError):
        leptrino.decode(frame)


def test_ft300_stream_bytes_right_behind_the_answer():
    decoder = robotiq_ft300.incoming()
    out = decoder.feed(data("ft300-start-fc16-reply") + data("ft300-stream"))
    assert out == [
        robotiq_ft300.ModbusWritten(410, 1),
        robotiq_ft300.Ft300Sample((100, -200, -1050, 100, -200, 50)),
    ]


def test_ft300_short_stop_is_no_stop():
    decoder = robotiq_ft300.requests()
    assert decoder.feed(b"\xff" * 49 + data("ft300-read-wrench")) == [
        robotiq_ft300.ReadRegisters(180, 6)
    ]
    assert decoder.feed(b"\xff" * 30) == []
    assert decoder.feed(b"\xff" * 20) == [robotiq_ft300.StreamStop()]


def test_ft300_refusal():
    (message,) = robotiq_ft300.incoming().feed(
        robotiq_ft300.encode(robotiq_ft300.ModbusRefusal(3, 2))
    )
    assert message == robotiq_ft300.ModbusRefusal(3, 2)


def test_ft300_registers_of_another_count_are_no_wrench():
    with pytest.raises(ProtocolError):
        robotiq_ft300.RegisterValues((1, 2, 3)).wrench()


def test_bota_marked_values_are_never_handed_on():
    (frame,) = protocol.incoming().feed(data("bota-frame-invalid"))
    assert not frame.usable
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


def test_a_buffered_datagram_holds_several_records():
    both = data("rdt-record") + data("rdt-record-after-loss")
    assert [record.rdt_sequence for record in net_ft.decode_records(both)] == [1, 5]


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
    with pytest.raises(ProtocolError) as refusal:
        net_ft.decode_page(PAGE.format(*fields).encode())
    assert refusal.value.what == what


def test_a_page_without_a_field_names_it():
    with pytest.raises(ProtocolError, match="cfgcpf"):
        net_ft.decode_page(b"<scfgfu>N</scfgfu><scfgtu>N-m</scfgtu>")


def test_a_calibration_in_pounds_is_refused():
    content = bytearray(data("netft-tcp-calibration-reply"))
    content[2] = 1
    with pytest.raises(ProtocolError) as refusal:
        net_ft.decode_calibration(bytes(content))
    assert refusal.value.what == "unit"


def test_wrenches_of_all_sensors_agree_on_one_load():
    wanted = VECTORS["ft300-stream"]["fields"]["force_n"]
    (ft300,) = robotiq_ft300.incoming().feed(data("ft300-stream"))
    (sample,) = protocol.incoming().feed(data("bota-frame"))
    (record,) = net_ft.decode_records(data("rdt-record"))
    for wrench in (ft300.wrench(), sample.wrench(), record.wrench(1e6, 1e6)):
        assert wrench.force_n == pytest.approx(wanted)
        assert wrench.torque_nm == pytest.approx((0.1, -0.2, 0.05))
