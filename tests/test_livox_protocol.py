"""Control frames of Livox SDK 1: published frames decode to what they are, and encode to the same bytes."""

import datetime as dt
import struct

import pytest
from artemis_drivers.livox_avia import payloads
from artemis_drivers.livox_avia.protocol import Frame, General, Kind, Lidar, crc16, crc32, decode, encode
from artemis_drivers.livox_avia.status import Status
from hypothesis import given, settings
from hypothesis import strategies as st

# frame, type, sequence number, command set, command, payload: constants of programs that drive real devices,
# one answer and two broadcasts of real devices (Mid-40, Tele-15, Avia), and frames of the official SDK
VECTORS = [
    ("aa010f0000000004d70002ae8a8a7b", 0, 0, 0, 2, ""),
    ("aa010f0000000004d7000338ba8d0c", 0, 0, 0, 3, ""),
    ("aa010f0000000004d70006b74ee77c", 0, 0, 0, 6, ""),
    ("aa010f0000000004d70102efbb9162", 0, 0, 1, 2, ""),
    ("aa010f0000000004d701054c2ef5fc", 0, 0, 1, 5, ""),
    ("aa010f0000000004d70109676243f5", 0, 0, 1, 9, ""),
    ("aa011000000000b809010301d271d049", 0, 0, 1, 3, "01"),
    ("aa011000000000b8090103004441d73e", 0, 0, 1, 3, "00"),
    ("aa011000000000b8090100011122fd62", 0, 0, 1, 0, "01"),
    ("aa011000000000b809010002ab73f4fb", 0, 0, 1, 0, "02"),
    ("aa011000000000b8090100033d43f38c", 0, 0, 1, 0, "03"),
    ("aa011000000000b809000400b4bd5470", 0, 0, 0, 4, "00"),
    ("aa011000000000b809000401228d5307", 0, 0, 0, 4, "01"),
    ("aa011000000000b809000500f58c4f69", 0, 0, 0, 5, "00"),
    ("aa011000000000b80900050163bc481e", 0, 0, 0, 5, "01"),
    ("aa011000000000b80901040115e79106", 0, 0, 1, 4, "01"),
    ("aa011000000000b80901040083d79671", 0, 0, 1, 4, "00"),
    ("aa011000000000b80901060001b5a043", 0, 0, 1, 6, "00"),
    ("aa011000000000b8090106019785a734", 0, 0, 1, 6, "01"),
    ("aa011000000000b8090106022dd4aead", 0, 0, 1, 6, "02"),
    ("aa011000000000b80901080119a824aa", 0, 0, 1, 8, "01"),
    ("aa011000000000b8090108008f9823dd", 0, 0, 1, 8, "00"),
    ("aa011100000000fc02000a000004477736", 0, 0, 0, 10, "0000"),
    ("aa011400000000a8240008000000000068f8dd50", 0, 0, 0, 8, "0000000000"),
    (
        "aa012700000000b5ed01010000000000000000000000000000000000000000000000004cdea4e7",
        *(0, 0, 1, 1, "000000000000000000000000000000000000000000000000"),
    ),
    ("aa011900000000dc580001c0a8012152c351c352c363925b8b", 0, 0, 0, 1, "c0a8012152c351c352c3"),
    ("aa010f00000100dcce00ff23decd83", 0, 1, 0, 255, ""),
    ("aa010f00000200b4e40002f63e1d0d", 0, 2, 0, 2, ""),
    ("aa010f000003006cfd01029bd54d2f", 0, 3, 1, 2, ""),
    ("aa010f0000040064b00009963b7701", 0, 4, 0, 9, ""),
    ("aa010f00000500bca90105d09c912a", 0, 5, 1, 5, ""),
    ("aa010f00000600d483010788934389", 0, 6, 1, 7, ""),
    ("aa010f000007000c9a0109a364b055", 0, 7, 1, 9, ""),
    ("aa011200000800f0d1000c010200a77f8a5c", 0, 8, 0, 12, "010200"),
    ("aa01170000000064390001c0a82101bd07e8fd1e25f912", 0, 0, 0, 1, "c0a82101bd07e8fd"),
    ("aa0110000100006453000100f1343c29", 1, 0, 0, 1, "00"),
    (
        "aa012200024800fff60000315051444c3548303031554c3939310002e8fdc51185fc",
        *(2, 72, 0, 0, "315051444c3548303031554c3939310002e8fd"),
    ),
    (
        "aa012200020000597e0000334a45444b314530303146363336310007e8fdf12fcc6b",
        *(2, 0, 0, 0, "334a45444b314530303146363336310007e8fd"),
    ),
    ("aa011700000800a4f7010a1405170040420f003e7c4a74", 0, 8, 1, 10, "1405170040420f00"),
]


@pytest.mark.parametrize(("text", "kind", "seq", "cmd_set", "cmd_id", "payload"), VECTORS)
def test_published_frames(text: str, kind: int, seq: int, cmd_set: int, cmd_id: int, payload: str) -> None:
    frame = Frame(kind, seq, cmd_set, cmd_id, bytes.fromhex(payload))
    assert decode(bytes.fromhex(text)) == ([frame], 0)
    assert encode(frame).hex() == text


def test_headers_published_without_their_tail() -> None:
    for text in ("aa012200024800fff6", "aa011900000000dc58"):
        assert crc16(bytes.fromhex(text)) == 0


def test_what_the_published_payloads_mean() -> None:
    by_name = {v[0]: bytes.fromhex(str(v[5])) for v in VECTORS}
    shake = by_name["aa011900000000dc580001c0a8012152c351c352c363925b8b"]
    assert payloads.Handshake.decode(shake) == payloads.Handshake("192.168.1.33", 50002, 50001, 50002)
    old = by_name["aa01170000000064390001c0a82101bd07e8fd1e25f912"]
    assert payloads.Handshake.decode(old) == payloads.Handshake("192.168.33.1", 1981, 65000, None)
    avia = payloads.Broadcast.decode(VECTORS[-2][5] and bytes.fromhex(str(VECTORS[-2][5])))
    assert avia == payloads.Broadcast("3JEDK1E001F6361", 7, 65000)
    tele = payloads.Broadcast.decode(bytes.fromhex(str(VECTORS[-3][5])))
    assert tele == payloads.Broadcast("1PQDL5H001UL991", 2, 65000)
    assert payloads.decode_keys(by_name["aa011200000800f0d1000c010200a77f8a5c"]) == [2]
    assert payloads.IpConfig.decode(bytes(5)) == payloads.IpConfig(False)
    assert payloads.decode_utc(bytes.fromhex("1405170040420f00")) == 1_590_192_001 * 10**9
    # an owner's log: 08:27:46 is sent as 1 666 000 000 microseconds
    utc = payloads.encode_utc(int(dt.datetime(2020, 5, 23, 8, 27, 46, tzinfo=dt.UTC).timestamp()) * 10**9)
    assert struct.unpack("<BBBBI", utc) == (20, 5, 23, 8, 1_666_000_000)


def test_status_of_a_synchronised_device() -> None:
    status = Status.decode(33280)  # logged by an owner
    assert (status.pps, status.sync, status.system, status.faults()) == (True, "gps", "ok", [])
    bad = Status.decode(2 | 1 << 4 | 1 << 6 | 4 << 14 | 2 << 30)
    assert bad.faults() == [
        *("temperature error", "motor warning", "system error"),
        *("window dirty or blocked", "time synchronisation abnormal"),
    ]


FRAMES = st.builds(
    Frame,
    st.sampled_from(list(Kind)),
    st.integers(0, 0xFFFF),
    st.integers(0, 255),
    st.integers(0, 255),
    st.binary(max_size=60),
)


@given(st.lists(st.tuples(st.binary(max_size=20), FRAMES), max_size=4), st.binary(max_size=14))
@settings(max_examples=300, deadline=None)
def test_frames_are_found_between_noise(parts: list[tuple[bytes, Frame]], tail: bytes) -> None:
    datagram = b"".join(noise + encode(frame) for noise, frame in parts) + tail
    frames, skipped = decode(datagram)
    assert frames == [frame for _, frame in parts]
    assert skipped == sum(len(noise) for noise, _ in parts) + len(tail)


@given(FRAMES, st.data())
@settings(max_examples=300, deadline=None)
def test_one_wrong_bit_is_never_believed(frame: Frame, data: st.DataObject) -> None:
    good = bytearray(encode(frame))
    bit = data.draw(st.integers(0, len(good) * 8 - 1))
    good[bit // 8] ^= 1 << bit % 8
    assert decode(bytes(good))[0] == []


@given(st.binary(max_size=1500))
@settings(max_examples=500, deadline=None)
def test_any_datagram_and_payload_is_survived(data: bytes) -> None:
    frames, skipped = decode(data)
    assert skipped + sum(len(encode(f)) for f in frames) == len(data)
    for reader in (
        payloads.Broadcast.decode,
        payloads.Handshake.decode,
        payloads.HeartbeatAck.decode,
        payloads.Extrinsic.decode,
        payloads.IpConfig.decode,
        payloads.ParamsAck.decode,
        payloads.decode_params,
        payloads.decode_keys,
        payloads.decode_utc,
    ):
        reader(data)


def test_a_frame_has_an_end() -> None:
    with pytest.raises(ValueError, match="1400"):
        encode(Frame(0, 0, 0, 0, bytes(1386)))
    assert len(encode(Frame(0, 0, 0, 0, bytes(1385)))) == 1400
    lie = struct.pack("<BBHBH", 0xAA, 1, 1401, 0, 0)
    lie += struct.pack("<H", crc16(lie)) + bytes(1388)
    lie += struct.pack("<I", crc32(lie))
    assert decode(lie) == ([], len(lie))


IPS = st.ip_addresses(v=4).map(str)
PORTS = st.integers(0, 0xFFFF)
CODES = st.text("0123456789ABCDEFGHJK", min_size=1, max_size=15)


PAYLOADS = st.one_of(
    st.builds(payloads.Handshake, IPS, PORTS, PORTS, st.none() | PORTS),
    st.builds(payloads.Broadcast, CODES, st.integers(0, 255), PORTS),
    st.builds(payloads.HeartbeatAck, *(st.integers(0, 255),) * 3, st.integers(0, 2**32 - 1)),
    st.builds(
        payloads.Extrinsic, *(st.floats(-360, 360, width=32),) * 3, *(st.integers(-(2**31), 2**31 - 1),) * 3
    ),
    st.builds(payloads.IpConfig, st.booleans(), IPS, st.none(), st.none()),
    st.builds(payloads.IpConfig, st.booleans(), *(IPS,) * 3),
)


@given(PAYLOADS)
@settings(max_examples=300, deadline=None)
def test_payloads_are_inverse(value: payloads.Handshake) -> None:
    assert type(value).decode(value.encode()) == value
    assert all(type(value).decode(value.encode()[:n]) is None for n in range(5))


@given(st.dictionaries(st.integers(0, 0xFFFF), st.binary(max_size=9), max_size=5), st.integers(0, 255))
@settings(max_examples=100, deadline=None)
def test_parameters_are_inverse(values: dict[int, bytes], ret: int) -> None:
    assert payloads.decode_params(payloads.encode_params(values)) == values
    assert payloads.decode_keys(payloads.encode_keys(list(values))) == list(values)
    ack = payloads.ParamsAck(ret, 2, 1, values)
    assert payloads.ParamsAck.decode(ack.encode()) == ack
    assert payloads.ParamsAck.decode(bytes([ret])) == payloads.ParamsAck(ret, 0, 0, {})


@given(st.datetimes(dt.datetime(2000, 1, 1), dt.datetime(2255, 12, 31, 23, 59, 59)))
@settings(max_examples=200, deadline=None)
def test_utc_is_inverse(moment: dt.datetime) -> None:
    us = (moment - dt.datetime(1970, 1, 1)) // dt.timedelta(microseconds=1)
    assert payloads.decode_utc(payloads.encode_utc(us * 1000)) == us * 1000


def test_utc_of_other_centuries_is_refused() -> None:
    with pytest.raises(ValueError, match="1999"):
        payloads.encode_utc(int(dt.datetime(1999, 12, 31, tzinfo=dt.UTC).timestamp()) * 10**9)
    assert payloads.decode_utc(bytes([20, 13, 1, 0, 0, 0, 0, 0])) is None


def test_command_numbers() -> None:
    assert [int(c) for c in General] == list(range(14)) and [int(c) for c in Lidar] == list(range(11))
