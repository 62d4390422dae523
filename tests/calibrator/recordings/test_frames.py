import gzip
import importlib.util
import io
import logging
import re
import struct
import zlib
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import CLOCK_GAP_S, DAMAGED, Frames, repaired_time
from calibrator.recordings.frames import read_frames
from calibrator.recordings.log_files import _READ_BYTES, BLOCK_BYTES
from calibrator.recordings.text_logs import parse_candump

PYTHON_CAN_FORMATS = (".log", ".asc", ".blf", ".trc")


def some_messages(count: int = 200) -> list[can.Message]:
    rng = np.random.default_rng(1)
    return [
        can.Message(
            timestamp=1_700_000_000.0 + 0.01 * k,
            arbitration_id=int(rng.integers(0x800 if k % 3 else 0x1FFFFFFF)),
            is_extended_id=k % 3 == 0,
            data=rng.bytes(int(rng.integers(9))),
            channel=0,
        )
        for k in range(count)
    ]


def write_log(path: Path, messages: list[can.Message]) -> Path:
    with can.Logger(path) as log:
        for message in messages:
            log.on_message_received(message)
    return path


def contents(frames: Frames) -> list[tuple[int, bytes]]:
    return [(int(key), frames.data[k, : frames.length[k]].tobytes()) for k, key in enumerate(frames.key)]


def expected_contents(messages: list[can.Message]) -> list[tuple[int, bytes]]:
    return [(m.arbitration_id | (1 << 31 if m.is_extended_id else 0), bytes(m.data)) for m in messages]


@pytest.mark.parametrize("suffix", [*PYTHON_CAN_FORMATS, ".mf4"])
def test_every_format_gives_the_frames_that_were_logged_packed_or_not(tmp_path: Path, suffix: str) -> None:
    path = write_log(tmp_path / f"drive{suffix}", some_messages())
    packed = tmp_path / f"packed{suffix}.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    frames = read_frames(path)
    assert contents(read_frames(packed)) == contents(frames) == expected_contents(some_messages())
    np.testing.assert_allclose(frames.time_s, 0.01 * np.arange(len(frames)), atol=1e-6)
    assert frames.damaged == 0


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".mf4"])
def test_can_fd_frames_keep_all_their_bytes(tmp_path: Path, suffix: str) -> None:
    messages = [
        can.Message(timestamp=1.7e9 + k, arbitration_id=0x123, is_extended_id=False, is_fd=True, data=bytes(range(n)))
        for k, n in enumerate((3, 8, 12, 64))
    ]
    frames = read_frames(write_log(tmp_path / f"fd{suffix}", messages))
    assert contents(frames) == expected_contents(messages)
    assert frames.data.shape == (4, 64)


def test_remote_and_error_frames_are_counted_but_carry_no_data(tmp_path: Path) -> None:
    lines = ["(1.000000) can0 123#R8", "(1.100000) can0 123#R", "(1.200000) can0 20000080#0000000000000000"]
    path = tmp_path / "drive.log"
    path.write_text("\n".join([*lines, "(1.300000) can0 124#0102\n"]))
    frames = read_frames(path)
    assert (len(frames), frames.remote_frames, frames.error_frames, frames.damaged) == (1, 2, 1, 0)


candump_lines = st.builds(
    lambda time, channel, identifier, data, tail: f"({time:.6f}) {channel} {identifier}#{data}{tail}",
    st.floats(0.0, 2e9),
    st.sampled_from(["can0", "vcan12", "x"]),
    st.one_of(st.integers(0, 0x7FF).map(lambda i: f"{i:03X}"), st.integers(0, 0x1FFFFFFF).map(lambda i: f"{i:08x}")),
    st.one_of(
        st.binary(max_size=8).map(lambda data: data.hex().upper()),
        st.sampled_from([3, 12, 48, 64]).map(lambda n: "#1" + bytes(range(n)).hex()),
        st.just("R4"),
    ),
    st.sampled_from(["", " R", " T"]),
)


@given(st.lists(candump_lines, min_size=1, max_size=30), st.sampled_from(["\n", "\r\n", "\n\n"]))
def test_the_candump_parser_agrees_with_python_can(lines: list[str], line_end: str) -> None:
    text = line_end.join(lines) + line_end
    found, kind = parse_candump(text.encode())
    messages = [m for m in can.CanutilsLogReader(io.StringIO(text)) if not m.is_remote_frame]
    assert not (kind == DAMAGED).any()
    assert contents(found) == expected_contents(messages)
    np.testing.assert_allclose(found.time_ns * 1e-9, [m.timestamp for m in messages], atol=1e-6, rtol=0)
    assert [found.channels[c] for c in found.channel] == [str(m.channel) for m in messages]


@given(st.text(alphabet="()#0123456789AFGRTcan .\r-", max_size=80))
def test_a_damaged_line_is_counted_and_its_neighbours_are_read(line: str) -> None:
    good = "(1.000000) can0 123#01\n"
    found, kind = parse_candump(f"{good}{line}\n{good}".encode())
    kept = contents(found)
    assert kept[0] == kept[-1] == (0x123, b"\x01")
    assert len(kept) + found.damaged + found.remote_frames + found.error_frames == np.count_nonzero(kind)


@pytest.mark.parametrize(
    "line",
    [
        "(1.000000) can0 123#012",
        "(1.000000) can0 123#0G",
        "(1.000000) can0 1234#01",
        "(1.000000) can0 FFF#01",
        "(1.0) can0 123#01",
        "(x.000000) can0 123#01",
        "(1.000000) can0 123#010203040506070809",
        "(1.000000) can0 123##",
        "(1.000000) can0 123##1" + "00" * 65,
        "1.000000 can0 123#01",
        "(1.000000) can0",
        "(1.000000) can0 123#01 X",
        "garbage",
    ],
)
def test_this_line_is_damaged(line: str) -> None:
    found, kind = parse_candump(f"(1.000000) can0 123#01\n\n{line}\n".encode())
    assert (len(found), np.flatnonzero(kind == DAMAGED).tolist()) == (1, [2])


def test_a_log_with_many_damaged_lines_is_refused_with_the_first_of_them(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    path.write_text("(1.000000) can0 123#01\n" * 9 + "nonsense\n")
    with pytest.raises(LogError, match=r"drive\.log: line 10 is damaged, and 1 of 10 lines are; expected .*9 frames"):
        read_frames(path)


def test_a_log_longer_than_one_block_keeps_order_and_line_numbers(tmp_path: Path) -> None:
    line = "({:.6f}) can0 123#0102030405060708\n"
    count = BLOCK_BYTES // len(line.format(1.0)) + 1000
    path = tmp_path / "long.log"
    path.write_text("".join(line.format(1000.0 + 0.001 * k) for k in range(count)) + "?\n")
    frames = read_frames(path)
    assert len(frames) == count
    assert np.all(np.diff(frames.time_ns) > 0)
    path.write_text("?\n" * count + "(1.000000) can0 123#01\n")
    with pytest.raises(LogError, match="line 1 is damaged"):
        read_frames(path)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".trc", ".log.gz"])
def test_an_empty_log_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"empty{suffix}"
    path.write_bytes(gzip.compress(b"") if suffix.endswith(".gz") else b"")
    with pytest.raises(LogError, match="the log is empty"):
        read_frames(path)


def cut_log(tmp_path: Path, suffix: str, share: float) -> tuple[Path, list[bytes]]:
    """A gzipped log that is cut off, and the whole lines that `gzip -dc` gets out of it."""
    packed = gzip.compress(write_log(tmp_path / f"drive{suffix}", some_messages(20_000)).read_bytes())
    cut = tmp_path / f"cut{suffix}.gz"
    cut.write_bytes(packed[: int(share * len(packed))])
    readable = zlib.decompressobj(wbits=31).decompress(cut.read_bytes())
    return cut, readable[: readable.rfind(b"\n") + 1].splitlines(keepends=True)


@pytest.mark.parametrize("share", [0.02, 0.5, 0.99])
def test_a_truncated_gzip_names_the_line_and_the_readable_frames(tmp_path: Path, share: float) -> None:
    cut, lines = cut_log(tmp_path, ".log", share)
    with pytest.raises(LogError, match=r"the compressed file is cut off; .* copy the file again") as told:
        read_frames(cut)
    line, frames = map(int, re.findall(r"after line (\d+).* (\d+) frames before it are readable", str(told.value))[0])
    assert line == frames
    assert len(lines) - _READ_BYTES // min(map(len, lines)) <= line <= len(lines)


def test_a_blf_with_an_object_of_no_size_ends_in_an_error_not_in_a_loop(tmp_path: Path) -> None:
    path = tmp_path / "loop.blf"
    inner = struct.pack("<4sHHLL", b"LOBJ", 32, 1, 0, 1) + bytes(64)
    container = struct.pack("<H6xL4x", 0, len(inner)) + inner
    header = struct.pack("<4sL", b"LOGG", 144).ljust(144, b"\0")
    path.write_bytes(header + struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(container), 10) + container)
    with pytest.raises(LogError, match="a container holds an object of 0 bytes"):
        read_frames(path)


@pytest.mark.parametrize(
    "line", ["0.05 1  12Z  Rx   d 2 01 02", "0.05 1  123  Rx   d 8 01 02", "9" * 12 + ".0 1 1 Rx d 0"]
)
def test_a_damaged_asc_line_is_left_out_and_counted(tmp_path: Path, line: str) -> None:
    path = write_log(tmp_path / "drive.asc", some_messages(20))
    path.write_text(f"{path.read_text()}{line}\n")
    frames = read_frames(path)
    assert (len(frames), frames.damaged, frames.first_damaged) == (20, 1, len(path.read_text().splitlines()))


def test_a_damaged_asc_line_among_those_of_can_fd_is_named(tmp_path: Path) -> None:
    path = write_log(tmp_path / "drive.asc", some_messages(20))
    lines = path.read_text().splitlines()
    lines[10:11] = ["0.05 CANFD 1 Rx 123 1 0 9 12 " + "00 " * 12, "0.050000 1  12Z  Rx   d 2 01 02"]
    path.write_text("\n".join(lines))
    with pytest.raises(LogError, match=r"drive\.asc: damaged at line 12 .*\d+ frames before it are readable"):
        read_frames(path)


def test_an_asc_with_relative_time_stamps_is_refused(tmp_path: Path) -> None:
    path = write_log(tmp_path / "drive.asc", some_messages(20))
    path.write_text(path.read_text().replace("timestamps absolute", "timestamps relative"))
    with pytest.raises(LogError, match="relative to the line before"):
        read_frames(path)


def test_what_python_can_complains_of_is_counted_and_not_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    path = write_log(tmp_path / "drive.trc", some_messages(20))
    path.write_text(path.read_text() + "     21 \n")
    with caplog.at_level(logging.DEBUG):
        frames = read_frames(path)
    assert frames.damaged == 1
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def test_mf4_without_asammdf_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    path = tmp_path / "drive.mf4"
    path.write_bytes(b"MDF")
    with pytest.raises(LogError, match=r"pip install 'hv-current-correction\[mf4\]'"):
        read_frames(path)


@pytest.mark.parametrize("suffix", [".asc", ".trc", ".asc.gz"])
def test_binary_data_under_the_name_of_a_text_log_is_not_called_empty(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"noise{suffix}"
    noise = np.random.default_rng(1).bytes(5000)
    path.write_bytes(gzip.compress(noise) if suffix.endswith(".gz") else noise)
    with pytest.raises(LogError, match=rf"noise{suffix}: not a {suffix[:4]} log but binary data; give the file"):
        read_frames(path)


def nanoseconds(*seconds: float) -> NDArray[np.int64]:
    return np.array([round(s * 1e9) for s in seconds], np.int64)


def test_slight_disorder_is_sorted_and_counted() -> None:
    time = repaired_time(nanoseconds(10.0, 10.2, 10.1, 10.3))
    assert time.order.tolist() == [0, 2, 1, 3]
    np.testing.assert_allclose(time.time_s, [0.0, 0.1, 0.2, 0.3])
    assert (time.disordered, time.clock_steps) == (1, 0)


def test_a_clock_set_back_becomes_a_gap() -> None:
    time = repaired_time(nanoseconds(5000.0, 5001.0, 100.0, 101.0))
    np.testing.assert_allclose(time.time_s, [0.0, 1.0, 1.0 + CLOCK_GAP_S, 2.0 + CLOCK_GAP_S])
    assert (time.disordered, time.clock_steps) == (0, 1)


@given(st.lists(st.integers(0, 8 * 10**18), min_size=1, max_size=50))
def test_time_never_decreases_and_no_frame_is_lost(time_ns: list[int]) -> None:
    time = repaired_time(np.array(time_ns, np.int64))
    assert sorted(time.order.tolist()) == list(range(len(time_ns)))
    assert time.time_s[0] == 0.0
    assert np.all(np.diff(time.time_s) >= 0.0)
