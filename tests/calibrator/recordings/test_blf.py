"""The reader of BLF files against python-can's, object by object."""

import io
import struct
from collections.abc import Sequence

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibrator.errors import LogError
from calibrator.recordings import blf
from calibrator.recordings.blf import blf_frames
from calibrator.recordings.frame_arrays import Frames, frames_of

START = 1_700_000_000.0
CLASSIC, ERROR, FD, FD_64 = 1, 73, 100, 101


def written(messages: Sequence[can.Message], *, container_bytes: int = 1 << 17, compression: int = 6) -> bytes:
    buffer = io.BytesIO()
    buffer.close = lambda: None  # type: ignore[method-assign]
    writer = can.BLFWriter(buffer, compression_level=compression)
    writer.max_container_size = container_bytes
    with writer:
        for message in messages:
            writer.on_message_received(message)
    return buffer.getvalue()


def of_objects(*objects: bytes) -> bytes:
    """A file with one stored container of these objects, without a date."""
    return struct.pack("<4sL", b"LOGG", 144).ljust(144, b"\0") + a_container(*objects)


def a_container(*objects: bytes) -> bytes:
    inner = b"".join(each + bytes(len(each) % 4) for each in objects)
    container = struct.pack("<H6xL4x", 0, len(inner)) + inner
    return struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(container), 10) + container


def an_object(kind: int, body: bytes, *, version: int = 1, flags: int = 2, time: int = 1000) -> bytes:
    head = struct.pack("<LHHQ" if version == 1 else "<LHHQ8x", flags, 0, 0, time)
    size = 16 + len(head) + len(body)
    return struct.pack("<4sHHLL", b"LOBJ", 16 + len(head), version, size, kind) + head + body


def classic(identifier: int, data: bytes) -> bytes:
    return struct.pack("<HBBL8s", 1, 0, len(data), identifier, data)


def fd_64(data: bytes, *, code: int, valid: int) -> bytes:
    head = struct.pack("<BBBBLLLLLLLHBBL", 1, code, valid, 0, 0x123, 0, 0x1000, 0, 0, 0, 0, 0, 0, 0, 0)
    return head + data


SOUND = an_object(CLASSIC, classic(0x10, b"x"))


def assert_the_same(content: bytes) -> Frames:
    ours, theirs = blf_frames(io.BytesIO(content), "x.blf"), frames_of(list(can.BLFReader(io.BytesIO(content))))
    width = theirs.data.shape[1]
    np.testing.assert_array_equal(ours.key, theirs.key)
    np.testing.assert_array_equal(ours.length, theirs.length)
    np.testing.assert_array_equal(ours.data[:, :width], theirs.data)
    np.testing.assert_allclose(ours.time_ns, theirs.time_ns, rtol=0, atol=500)
    assert [ours.channels[c] for c in ours.channel] == [theirs.channels[c] for c in theirs.channel]
    counts = ("error_frames", "remote_frames", "damaged")
    assert [getattr(ours, name) for name in counts] == [getattr(theirs, name) for name in counts]
    return ours


def _message(time: float, extended: bool, identifier: int, channel: int, kind: str, data: bytes) -> can.Message:
    fd = kind == "fd"
    payload = data[: min(can.util.dlc2len(can.util.len2dlc(len(data))), len(data))] if fd else data[:8]
    if fd and len(payload) > 8:
        payload = payload.ljust(can.util.dlc2len(can.util.len2dlc(len(payload))), b"\0")
    return can.Message(
        timestamp=START + time,
        arbitration_id=identifier if extended else identifier & 0x7FF,
        is_extended_id=extended,
        is_fd=fd,
        is_error_frame=kind == "error",
        is_remote_frame=kind == "remote",
        channel=channel,
        data=b"" if kind == "remote" else payload,
    )


messages = st.builds(
    _message,
    st.floats(0.0, 1e4),
    st.booleans(),
    st.integers(0, 0x1FFFFFFF),
    st.integers(0, 3),
    st.sampled_from(["classic", "classic", "fd", "remote", "error"]),
    st.one_of(st.binary(max_size=64), st.just(b"LOBJ"), st.just(b"LOBJ" + bytes(60))),
)


@given(st.lists(messages, max_size=60), st.sampled_from([200, 1000, 1 << 17]), st.sampled_from([0, 6]))
def test_any_blf_log_is_read_as_by_python_can(log: list[can.Message], container_bytes: int, compression: int) -> None:
    assert_the_same(written(log, container_bytes=container_bytes, compression=compression))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("flags", [1, 2])
def test_both_blf_header_versions_and_time_units_are_read(version: int, flags: int) -> None:
    body = classic(0x123, b"12345678")
    frames = assert_the_same(of_objects(an_object(CLASSIC, body, version=version, flags=flags, time=7)))
    assert frames.time_ns.tolist() == [70_000 if flags == 1 else 7]


@pytest.mark.parametrize(("length", "code", "valid"), [(3, 3, 3), (64, 15, 64), (4, 9, 12), (12, 9, 0)])
def test_omitted_bytes_of_the_newer_can_fd_object_are_read_as_zeros(length: int, code: int, valid: int) -> None:
    body = fd_64(bytes(range(1, length + 1)), code=code, valid=valid)
    frames = assert_the_same(of_objects(an_object(FD_64, body), an_object(CLASSIC, classic(0x7, b"ab"))))
    expected = bytes(range(1, min(length, valid) + 1)).ljust(valid, b"\0")
    assert frames.data[0, : frames.length[0]].tobytes() == expected


@pytest.mark.parametrize("spoilt", [
    SOUND[:6] + struct.pack("<H", 7) + SOUND[8:],  # a header of unknown version
    an_object(CLASSIC, classic(0x11, b"x"), time=2**64 - 1),
])  # fmt: skip
def test_blf_object_that_cannot_be_a_frame_is_counted_as_damaged(spoilt: bytes) -> None:
    frames = blf_frames(io.BytesIO(of_objects(spoilt, SOUND)), "x.blf")
    assert (frames.key.tolist(), frames.damaged) == ([0x10], 1)


@pytest.mark.parametrize(("content", "message"), [
    (of_objects(an_object(CLASSIC, b"1234")), "an object of 36 bytes, which is impossible for its type"),
    (of_objects(SOUND[:8] + bytes(4) + SOUND[12:]), "a container holds an object of 0 bytes"),  # no endless loop
    (of_objects(SOUND, b"no object at all"), "something that is no object"),
    (of_objects(SOUND)[:-2], "the file ends before"),
    (of_objects(SOUND[:-4]), "the last object is cut"),
    (b"LOGG", "a header of 144 bytes is expected, found 4"),
])  # fmt: skip
def test_damaged_blf_is_refused_with_the_byte_position(content: bytes, message: str) -> None:
    with pytest.raises(LogError, match=rf"x\.blf: truncated or damaged BLF: at byte \d+ .*{message}.* before it"):
        blf_frames(io.BytesIO(content), "x.blf")


def test_log_of_another_format_under_the_name_of_a_blf_is_refused() -> None:
    with pytest.raises(LogError, match=r"x\.blf: not a BLF log, .*found b'\(1\.0'\); give the file the suffix"):
        blf_frames(io.BytesIO(b"(1.000000) can0 123#00\n"), "x.blf")


@pytest.mark.parametrize("wrong", [b"LOBJ" + bytes(60), b"no object" + bytes(40)])
def test_damaged_container_is_reported_with_the_number_of_frames_before_it(wrong: bytes) -> None:
    sound = an_object(CLASSIC, classic(0x123, b"\1"))
    before = of_objects(sound, sound) + a_container(sound)
    with pytest.raises(LogError, match=f"at byte {len(before)} .*; 3 frames before it are readable"):
        blf_frames(io.BytesIO(before + a_container(wrong) + a_container(sound)), "x.blf")


@pytest.mark.parametrize("batch_bytes", [1, 100, 1 << 21])
def test_frames_do_not_depend_on_how_containers_are_batched(batch_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blf, "BATCH_BYTES", batch_bytes)
    messages = [can.Message(timestamp=START + k, arbitration_id=k, data=bytes([k])) for k in range(100)]
    assert len(assert_the_same(written(messages, container_bytes=150))) == 100
