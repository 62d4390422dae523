"""Logs of every format read as frames: complete ones, damaged ones, and ones with wrong times."""

import gzip
import importlib.util
import io
import logging
import re
import zlib
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import CLOCK_GAP_S, DAMAGED, Frames, repaired_time
from calibrator.recordings.log_files import _READ_BYTES, BLOCK_BYTES
from calibrator.recordings.log_formats import read_frames
from calibrator.recordings.text_logs import parse_candump


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


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc", ".mf4", ".csv"])
def test_every_log_format_is_read_completely_compressed_or_not(tmp_path: Path, suffix: str) -> None:
    path = write_log(tmp_path / f"drive{suffix}", some_messages())
    packed = tmp_path / f"packed{suffix}.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    frames = read_frames(path)
    assert contents(read_frames(packed)) == contents(frames) == expected_contents(some_messages())
    np.testing.assert_allclose(frames.time_s, 0.01 * np.arange(len(frames)), atol=1e-6)
    assert frames.damaged == 0


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".mf4", ".csv"])
def test_frames_of_can_fd_are_read_with_all_their_bytes(tmp_path: Path, suffix: str) -> None:
    fd: dict[str, Any] = {"arbitration_id": 0x123, "is_extended_id": False, "is_fd": True}
    messages = [can.Message(timestamp=1.7e9 + n, data=bytes(range(n)), **fd) for n in (3, 8, 12, 64)]
    frames = read_frames(write_log(tmp_path / f"fd{suffix}", messages))
    assert contents(frames) == expected_contents(messages)
    assert frames.data.shape == (4, 64)
    assert [message.is_fd for message in frames.messages()] == [False, False, True, True]


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
def test_candump_parser_agrees_with_python_can(lines: list[str], line_end: str) -> None:
    text = line_end.join(lines) + line_end
    found, kind = parse_candump(text.encode())
    messages = [m for m in can.CanutilsLogReader(io.StringIO(text)) if not m.is_remote_frame]
    assert not (kind == DAMAGED).any()
    assert contents(found) == expected_contents(messages)
    np.testing.assert_allclose(found.time_ns * 1e-9, [m.timestamp for m in messages], atol=1e-6, rtol=0)
    assert [found.channels[c] for c in found.channel] == [str(m.channel) for m in messages]


@given(st.text(alphabet="()#0123456789AFGRTcan .\r\t\0-", max_size=80))
def test_damaged_candump_line_is_counted_and_its_neighbours_are_read(line: str) -> None:
    good = "(1.000000) can0 123#01\n"
    found, kind = parse_candump(f"{good}{line}\n{good}".encode())
    kept = contents(found)
    assert kept[0] == kept[-1] == (0x123, b"\x01")
    assert len(kept) + found.damaged + found.remote_frames + found.error_frames == np.count_nonzero(kind)


def test_channel_of_a_damaged_candump_line_is_not_listed() -> None:
    text = b"(1.000000) can0 123#01\n(2.000000) cxn0 123#GG\n" + 40 * b"\0" + b"\n(3.000000) can1 123#02"
    found, _ = parse_candump(text)
    assert (found.channels, found.damaged) == (("can0", "can1"), 2)


ERROR_FRAME = "(1.200000) can0 20000080#0000000000000000"


@pytest.mark.parametrize(("suffix", "line", "counts"), [
    (".log", "(1.000000) can0 123#012", (0, 0, 1)),
    (".log", "(1.000000) can0 123#0G", (0, 0, 1)),
    (".log", "(1.000000) can0 1234#01", (0, 0, 1)),
    (".log", "(1.000000) can0 FFF#01", (0, 0, 1)),
    (".log", "(1.0) can0 123#01", (0, 0, 1)),
    (".log", "(x.000000) can0 123#01", (0, 0, 1)),
    (".log", "(1.000000) can0 123#010203040506070809", (0, 0, 1)),
    (".log", "(1.000000) can0 123##", (0, 0, 1)),
    pytest.param(".log", "(1.000000) can0 123##1" + "00" * 65, (0, 0, 1), id="CAN FD with 65 bytes"),
    (".log", "1.000000 can0 123#01", (0, 0, 1)),
    (".log", "(1.000000) can0", (0, 0, 1)),
    (".log", "(1.000000) can0 123#01 X", (0, 0, 1)),
    (".log", "garbage", (0, 0, 1)),
    (".log", ERROR_FRAME, (1, 0, 0)),
    (".log", "(1.000000) can0 123#R8", (0, 1, 0)),
    (".log", "(1.000000) can0 123#R", (0, 1, 0)),
    (".asc", "0.05 1 12Z Rx d 2 01 02", (0, 0, 1)),
    (".asc", "0.05 1 123 Rx d 8 01 02", (0, 0, 1)),
    (".asc", "9000000000.0 1 1 Rx d 0", (0, 0, 1)),
    (".asc", "0.05 1 ErrorFrame", (1, 0, 0)),
    (".asc", "0.05 1 123 Rx r", (0, 1, 0)),
    (".trc", "     21 ", (0, 0, 1)),
])  # fmt: skip
def test_line_without_a_data_frame_is_left_out_and_counted(
    tmp_path: Path, suffix: str, line: str, counts: tuple[int, int, int], capfd: Any, caplog: Any
) -> None:
    path = write_log(tmp_path / f"drive{suffix}", some_messages(20))
    path.write_text(f"{path.read_text()}{line}\n")
    with caplog.at_level(logging.DEBUG, logger="can"):
        frames = read_frames(path)
    assert (len(frames), frames.error_frames, frames.remote_frames, frames.damaged) == (20, *counts)
    if suffix != ".trc" and frames.damaged:
        assert frames.first_damaged == len(path.read_text().splitlines())
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


NOISE = np.random.default_rng(1).bytes(5000)
GOOD = b"(1.000000) can0 123#01\n"


@pytest.mark.parametrize(("name", "content", "words"), [
    ("x.log", GOOD * 9 + b"nonsense\n", r"line 10 is damaged, and 1 of 10 lines are; expected .*; 9 frames are rea"),
    *((f"x{suffix}", b"", "the log is empty") for suffix in (".log", ".asc", ".trc")),
    ("x.log", (ERROR_FRAME + "\n").encode(), r"the log is empty: no data frames \(1 error frames"),
    ("x.log.gz", gzip.compress(b"", mtime=0), "the log is empty"),
    ("x.asc", NOISE, "not a .asc log but binary data; give the file the suffix of its format"),
    ("x.trc", NOISE, "not a .trc log but binary data"),
    ("x.asc.gz", gzip.compress(NOISE, mtime=0), "not a .asc log but binary data"),
    ("x.asc", b"base hex  timestamps relative\n", "the time stamps are relative to the line before; save it with"),
    ("x.asc", b"base dec\n0.1 1 12 Rx d 1 1\n0.2 1 12Z Rx d 1 1\n", r"damaged at line 3 .*; \d frames before it"),
])  # fmt: skip
def test_unusable_log_is_refused_with_the_reason(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError, match=rf"{name}: {words}"):
        read_frames(tmp_path / name)


def test_order_and_line_numbers_are_right_in_logs_longer_than_one_block(tmp_path: Path) -> None:
    line = "({:.6f}) can0 123#0102030405060708\n"
    count = BLOCK_BYTES // len(line.format(1.0)) + 1000
    path = tmp_path / "long.log"
    path.write_text("".join(line.format(1000.0 + 0.001 * k) for k in range(count)) + "?\n")
    frames = read_frames(path)
    assert len(frames) == count
    assert np.all(np.diff(frames.time_ns) > 0)
    assert frames.first_damaged == count + 1


@pytest.mark.parametrize("share", [0.02, 0.5, 0.99])
def test_truncated_gzip_is_reported_with_line_and_number_of_readable_frames(tmp_path: Path, share: float) -> None:
    packed = gzip.compress(write_log(tmp_path / "drive.log", some_messages(20_000)).read_bytes())
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(packed[: int(share * len(packed))])
    lines = zlib.decompressobj(wbits=31).decompress(cut.read_bytes()).split(b"\n")[:-1]
    with pytest.raises(LogError, match=r"the compressed file is cut off; .* copy the file again") as told:
        read_frames(cut)
    line, frames = map(int, re.findall(r"after line (\d+).* (\d+) frames before it are readable", str(told.value))[0])
    assert line == frames
    assert len(lines) - _READ_BYTES // min(map(len, lines)) <= line <= len(lines)


def test_mf4_without_asammdf_is_refused_with_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    path = tmp_path / "drive.mf4"
    path.write_bytes(b"MDF")
    with pytest.raises(LogError, match=r"pip install 'hv-current-correction\[mf4\]'"):
        read_frames(path)


@pytest.mark.parametrize(("logged_s", "time_s", "disordered", "clock_steps"), [
    ([10.0, 10.2, 10.1, 10.3], [0.0, 0.1, 0.2, 0.3], 1, 0),
    ([5000.0, 5001.0, 100.0, 101.0], [0.0, 1.0, 1.0 + CLOCK_GAP_S, 2.0 + CLOCK_GAP_S], 0, 1),
    ([0.0, 600.0, 1201.0], [0.0, 600.0, 600.0 + CLOCK_GAP_S], 0, 1),
])  # fmt: skip
def test_unordered_times_clock_steps_and_long_pauses_of_a_log_are_repaired(
    logged_s: list[float], time_s: list[float], disordered: int, clock_steps: int
) -> None:
    time = repaired_time(np.rint(1e9 * np.array(logged_s)).astype(np.int64))
    np.testing.assert_allclose(time.time_s, time_s)
    assert (time.disordered, time.clock_steps) == (disordered, clock_steps)


@given(st.lists(st.integers(0, 8 * 10**18), min_size=1, max_size=50))
def test_repaired_time_never_decreases_and_no_frame_is_lost(time_ns: list[int]) -> None:
    time = repaired_time(np.array(time_ns, np.int64))
    assert sorted(time.order.tolist()) == list(range(len(time_ns)))
    assert time.time_s[0] == 0.0
    assert np.all(np.diff(time.time_s) >= 0.0)
