"""Files that were cut off or damaged: what is whole is recovered, the original is not touched."""

from __future__ import annotations

import json
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Message

from artemis_edge import topics
from artemis_edge.cli import main
from artemis_edge.datasets import open_input
from artemis_edge.errors import InputError
from artemis_edge.session.files import Limits, SessionFiles
from artemis_edge.session.mcap_file import MAGIC, GrowingFile, McapFile
from artemis_edge.session.recover import recover
from artemis_edge.session.verify import verify
from artemis_edge.session.writer import SessionWriter
from tests.recordings import SECOND, START, numbers, sent


def _recording(folder: Path, chunks: int = 3, of: int = 4) -> Path:
    files = SessionFiles(
        folder, {"calibration.toml": "x = 1\n"}, {"d": {"serial": "7"}}, Limits(reserve_bytes=0)
    )
    for k in range(chunks * of):
        files.write(sent(k, 30))
        if k % of == of - 1:
            files.flush()
    files.close()
    return folder / "session_000.mcap"


def _record_ends(path: Path) -> list[int]:
    """Where top-level records end, of the twin that reads byte by byte."""
    data, at, ends = path.read_bytes(), 8, []
    while at < len(data) - 8:
        size = int.from_bytes(data[at + 1 : at + 9], "little")
        at += 9 + size
        ends.append(at)
    return ends


def test_cut_at_every_byte_of_the_last_chunk(tmp_path: Path) -> None:
    """All complete chunks are recovered, nothing else, and the original stays as it was."""
    path = _recording(tmp_path)
    data = path.read_bytes()
    ends = [0, *_record_ends(path)]
    kinds = [data[end] if end else 0 for end in ends[:-1]]
    start = max(end for end, kind in zip(ends, kinds, strict=False) if kind == Opcode.CHUNK)
    stop = next(end for end in ends if end > start)
    whole = [
        end
        for end, kind in zip(ends[1:], [data[e] if e else data[8] for e in ends], strict=False)
        if kind == 6
    ]
    assert len(whole) == 3 and whole[-1] == stop
    for cut in range(start, stop + 1):
        torn = tmp_path / "torn.mcap"
        torn.write_bytes(data[:cut])
        copy = tmp_path / "copy.mcap"
        report = recover(torn, copy)
        complete = sum(end <= cut for end in whole)
        assert report.chunks == complete and not report.finished
        assert numbers(copy) == list(range(complete * 4))
        assert torn.read_bytes() == data[:cut]
        assert verify(copy)[0].problems == []
        copy.unlink()


def test_a_copy_has_all_and_others_read_it(tmp_path: Path) -> None:
    path = _recording(tmp_path)
    ends = _record_ends(path)
    path.write_bytes(path.read_bytes()[: ends[-2]])
    report = recover(path)
    assert report.copy == tmp_path / "session_000_recovered.mcap"
    assert (report.messages, report.attachments, report.first_ns) == (12, 1, START)
    with report.copy.open("rb") as stream:
        reader = make_reader(stream)
        assert [m.sequence for _, _, m in reader.iter_messages()] == list(range(12))
        assert [a.name for a in reader.iter_attachments()] == ["calibration.toml"]
        assert [m.metadata for m in reader.iter_metadata()] == [{"serial": "7"}]


def test_a_damaged_chunk_in_the_middle_is_told_and_left_out(tmp_path: Path) -> None:
    path = _recording(tmp_path)
    data = bytearray(path.read_bytes())
    at = [end for end in _record_ends(path) if data[end : end + 1] == b"\x06"][1]
    data[at + 80] ^= 0xFF
    path.write_bytes(data)
    (verdict,) = verify(path)
    assert len(verdict.problems) == 1 and f"byte {at}" in verdict.problems[0]
    report = recover(path)
    assert numbers(report.copy) == [0, 1, 2, 3, 8, 9, 10, 11]
    assert report.damaged == verdict.problems


def test_any_damage_is_survived(tmp_path: Path) -> None:
    """Random bytes anywhere: no exception but InputError, and never a message that was not there."""
    path, rng = _recording(tmp_path), np.random.default_rng(3)
    data = path.read_bytes()
    for k in range(150):
        broken = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 6)):
            broken[at] = rng.integers(256)
        torn, copy = tmp_path / "torn.mcap", tmp_path / f"copy{k}.mcap"
        torn.write_bytes(broken)
        try:
            recover(torn, copy)
        except InputError:
            assert broken[:8] != data[:8]
            continue
        assert verify(copy)[0].problems == []
        assert set(numbers(copy)) <= set(range(12))
        verify(torn)


def _zeros(data: bytes, at: int, size: int) -> bytes:
    return data[:at] + bytes(min(size, len(data) - at)) + data[at + size :]


def _left_out(data: bytes, at: int, size: int) -> bytes:
    return data[:at] + data[at + size :]


def _repeated(data: bytes, at: int, size: int) -> bytes:
    return data[: at + size] + data[at:]


def _swapped(data: bytes, at: int, size: int) -> bytes:
    return data[:at] + data[at + size : at + 2 * size] + data[at : at + size] + data[at + 2 * size :]


def _long(data: bytes, at: int, size: int) -> bytes:
    """A length, or whatever stands there, is enormous."""
    return data[:at] + b"\xff" * 8 + data[at + 8 :]


def _followed(data: bytes, at: int, size: int) -> bytes:
    """The file goes on behind its end with a part of itself, as in a block that was another file's."""
    return data + data[at : at + size]


@pytest.mark.parametrize("damage", [_zeros, _left_out, _repeated, _swapped, _long, _followed])
def test_what_disks_do_is_survived(
    damage: Callable[[bytes, int, int], bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Blocks lost, repeated or exchanged: no command fails but with a sentence, no message is invented or altered."""
    folder = tmp_path / "walk"
    path = _session(folder, 1)
    data, rng = path.read_bytes(), np.random.default_rng(5)
    true = {message.data for _, message in McapFile(path).records() if isinstance(message, Message)}
    for k in range(8):
        at = int(rng.integers(0, len(data) - 8)) if k else len(MAGIC)
        path.write_bytes(damage(data, at, int(rng.choice([16, 64, 512]))))
        out = tmp_path / f"out{k}"
        verdicts = [main(["session", word, str(folder)]) for word in ("verify", "info")]
        verdicts.append(main(["session", "recover", str(folder), "--out", str(out)]))
        verdicts.append(
            main(["session", "trim", str(folder), "--to", "1", "--out", str(tmp_path / f"part{k}")])
        )
        assert set(verdicts) <= {0, 1, 2} and main(["session", "list", str(tmp_path)]) == 0
        for copy in out.glob("*.mcap"):
            assert verify(copy)[0].problems == []
            found = [m.data for _, m in McapFile(copy).records() if isinstance(m, Message)]
            assert set(found) <= true
    assert "Traceback" not in capsys.readouterr().err


def test_a_length_may_claim_what_it_likes(tmp_path: Path) -> None:
    """Every eight bytes of the file once as a number beyond all bounds: no memory is asked for."""
    path = _recording(tmp_path, 1, 2)
    data, torn = path.read_bytes(), tmp_path / "torn.mcap"
    limit = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), limit[1]))
    try:
        for at in range(len(MAGIC), len(data) - 8, 3):
            torn.write_bytes(data[:at] + b"\xfe\xff\xff\xff\0\0\0\0" + data[at + 8 :])
            verify(torn)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limit)


def test_no_file_is_overwritten(tmp_path: Path) -> None:
    path = _recording(tmp_path)
    with pytest.raises(InputError, match="is there already"):
        recover(path, path)
    (tmp_path / "no.mcap").write_bytes(b"something else")
    with pytest.raises(InputError, match="not an MCAP file"):
        recover(tmp_path / "no.mcap", tmp_path / "new.mcap")


def _session(folder: Path, seconds: int = 3) -> Path:
    path = folder / "session.mcap"
    with SessionWriter(path) as out:
        out.write_tf_static(START, "lidar", "cam", np.eye(4))
        for k in range(seconds * 10):
            at = START + k * SECOND // 10
            out.write_points(at, np.full((20, 3), 1.0 + k, np.float32), offset_ns=np.arange(20) * 1000)
            out.write_imu(at, np.zeros(3), np.array([0, 0, 9.81]))
    return path


def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "walk"
    path = _session(folder)
    assert main(["session", "verify", str(folder)]) == 0
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    assert main(["session", "verify", str(folder)]) == 1
    assert "session recover" in capsys.readouterr().out
    assert main(["session", "list", str(tmp_path)]) == 0
    assert "damaged (1 truncated_file): session recover makes a copy" in capsys.readouterr().out
    assert main(["session", "recover", str(folder)]) == 0
    assert (tmp_path / "walk_recovered" / "session.mcap").is_file()
    assert path.read_bytes() == data[: len(data) * 2 // 3]
    path.write_bytes(data)
    capsys.readouterr()
    assert main(["session", "list", str(tmp_path), "--json"]) == 0
    cards = json.loads(capsys.readouterr().out)["sessions"]
    assert [card["name"] for card in cards] == ["walk", "walk_recovered"]
    assert [card["lost"] for card in cards] == [{}, {}]
    assert cards[0]["recorded"] == "2025-12-28 23:59:00" and cards[0]["duration_s"] == 2.9
    assert main(["session", "list", str(tmp_path / "nowhere")]) == 2


def test_trim_keeps_the_part_and_what_holds_for_the_whole(tmp_path: Path) -> None:
    folder = tmp_path / "walk"
    _session(folder)
    part = tmp_path / "part"
    assert main(["session", "trim", str(folder), "--from", "1", "--to", "2", "--out", str(part)]) == 0
    source = open_input(part)
    assert source.stamp_ns.tolist() == [START + k * SECOND // 10 for k in range(10, 20)]
    assert verify(part)[0].topics == {topics.TF_STATIC.name: 1, "/lidar/points": 10, "/imu": 10}
    assert main(["session", "trim", str(folder), "--from", "1", "--to", "2", "--out", str(part)]) == 2
    assert (
        main(["session", "trim", str(folder), "--from", "2", "--to", "1", "--out", str(tmp_path / "x")]) == 2
    )
    for late in ("9", "1e300"):
        assert main(["session", "trim", str(folder), "--from", late, "--out", str(tmp_path / "y")]) == 2
    assert not (tmp_path / "y").exists()


def _spoil(path: Path, first: int, count: int = 60) -> None:
    data = bytearray(path.read_bytes())
    data[first : first + count] = bytes(255 - byte for byte in data[first : first + count])
    path.write_bytes(data)


def test_what_a_damaged_chunk_costs_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _recording(tmp_path / "walk")
    chunk = next(at for at, record in McapFile(path).records() if isinstance(record, Message))
    _spoil(path, chunk + 60)
    assert main(["session", "recover", str(tmp_path / "walk")]) == 0
    said = capsys.readouterr().out
    assert "8 of the 12 messages" in said and f"the record at byte {chunk} is damaged" in said
    assert "was complete" not in said
    out = tmp_path / "part"
    assert main(["session", "trim", str(tmp_path / "walk"), "--out", str(out)]) == 1
    assert f"missing: the record at byte {chunk} is damaged" in capsys.readouterr().out


def test_what_holds_nothing_is_not_recovered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    for name, content in (("nothing", MAGIC + rng.bytes(5000)), ("garbage", rng.bytes(5000)), ("empty", b"")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "session.mcap").write_bytes(content)
        assert main(["session", "recover", str(tmp_path / name)]) in (1, 2)
        assert capsys.readouterr().err.count("\n") == 1
        assert not (tmp_path / f"{name}_recovered").exists()


def test_a_damaged_length_ends_the_search_for_the_latest_message(tmp_path: Path) -> None:
    path = tmp_path / "session_000.mcap"
    path.write_bytes(MAGIC + b"\x06" + b"\xff" * 300)
    assert GrowingFile(path).latest_number() == -1
