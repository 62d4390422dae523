"""A gateway for which the kernel carries all frames but those that only it may send: killed, with forged frames, with
joined buses."""

import os
import re
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from statistics import median

import pytest

from ecu_node.bus.kernel_routes import KernelRoutes
from ecu_node.core.status import Reason, State
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError
from tests.vcan.conftest import AUXILIARY, BATTERY, STATUS, StartNode, state_of
from tests.vcan.processes import (
    CHANNEL,
    ECU_NODE,
    LONGEST_WAIT_S,
    OTHER_CHANNEL,
    Recording,
    bring_up,
    generate,
    playing,
    run_tool,
    running_recording,
    send,
    wait_until,
)

NOISE, BACK = 0x345, 0x346
"""Identifiers of others, sent towards the vehicle and towards the sensors."""
RULES = 2 * (34 + 1)
"""Number of rules, in both directions: for all 11-bit identifiers but those of the five branches and the status, and
one for all 29-bit identifiers."""
INSTANTS = 150
GATEWAY = ("--gateway", OTHER_CHANNEL)
FOREIGN = "FFFFFFFFFFFFFFFF"
"""What another node sends under the battery's identifier."""


@pytest.fixture(autouse=True)
def no_rules() -> Iterator[None]:
    """Begin and end without rules in the kernel, so that rules left by one test do not affect others."""
    subprocess.run(["cangw", "-F"], check=True)
    yield
    subprocess.run(["cangw", "-F"], check=True)


def rules() -> list[tuple[str, ...]]:
    """Source, identifier and mask of the kernel's rules; ``cangw -L`` fails where there are as many as of a gateway."""
    lines = [line.split() for line in Path("/proc/net/can/rcvlist_fil").read_text().splitlines()]
    return sorted(tuple(words[:3]) for words in lines if words[-1:] == ["gw"])


@contextmanager
def noise(count: int) -> Iterator[None]:
    """Within the block, send numbered frames of others on both buses, one each 8 ms; at its end all have been sent."""
    ways = ((CHANNEL, NOISE), (OTHER_CHANNEL, BACK))
    options = ["-D", "i", "-L", "8", "-n", str(count), "-g", "8"]
    running = [subprocess.Popen(["cangen", channel, "-I", f"{number:X}", *options]) for channel, number in ways]
    try:
        yield
        assert [process.wait(LONGEST_WAIT_S) for process in running] == [0, 0]
    finally:
        for process in running:
            process.kill()


def delays_s(identifier: int, sent: Recording, arrived: Recording) -> list[float]:
    """How long frames of one identifier took from one bus to the other, by the kernel's time stamps. [s]"""
    stamps = [
        [float(line.split()[0][1:-1]) for line in side.log.read_text().splitlines() if f" {identifier:X}#" in line]
        for side in (sent, arrived)
    ]
    return [after - before for before, after in zip(*stamps, strict=True)]


def test_frames_pass_while_the_gateway_is_killed(start_gateway: StartNode, here: Recording, there: Recording) -> None:
    with start_gateway() as node:
        at_work = rules()
        with noise(400):
            there.wait_for(NOISE, 100)
            node.stop(signal.SIGKILL)
            while_killed = len(there.data_of(NOISE))
            there.wait_for(NOISE, while_killed + 150)
            with start_gateway() as again:
                assert rules() == at_work, "those that were left are used again, not doubled"
        wait_until(lambda: len(here.frames) >= 800, "all frames towards the sensors")
        wait_until(lambda: len(there.data_of(NOISE)) >= 400, "all frames towards the vehicle")
        for identifier in (NOISE, BACK):
            numbers = [int.from_bytes(data, "little") for data in here.data_of(identifier)]
            assert numbers == list(range(400)), "none lost, none twice"
            assert there.data_of(identifier) == here.data_of(identifier)
        delays = delays_s(NOISE, here, there)
        assert median(delays[while_killed : while_killed + 150]) < 2e-3, "by the kernel alone"
    assert len(at_work) == len(set(at_work)) == RULES
    assert again.process.returncode is not None


def test_kernel_rules_are_removed_when_the_gateway_ends(start_gateway: StartNode, there: Recording) -> None:
    with start_gateway("--fd") as node:
        assert len(rules()) == 2 * RULES, "both ways, classic and FD"
        node.stop(signal.SIGKILL)
    with start_gateway() as node:
        assert len(rules()) == RULES, "those of another kind are replaced"
        assert node.stop() == 0
    assert rules() == []
    send(f"{NOISE:X}#01")
    send(f"{BACK:X}#01", OTHER_CHANNEL)
    there.wait_for(BACK, 1)
    assert there.data_of(NOISE) == []


def test_removed_kernel_rules_are_restored(start_gateway: StartNode) -> None:
    mine = ("-s", CHANNEL, "-d", OTHER_CHANNEL, "-f", "345:7FF", "-X")
    with start_gateway() as node:
        before = rules()
        run_tool("cangw", "-F")
        run_tool("cangw", "-A", *mine)
        node.wait_for(f"vcan0 and vcan1: {RULES} rules of the kernel were not as they must be; they are now")
        assert len(rules()) == len(before) + 1, "a rule that somebody else has set stays"
        run_tool("ip", "link", "del", OTHER_CHANNEL)
        node.wait_for("the kernel carries no frames: ")
        assert rules() == [], "neither way is open"
        run_tool("ip", "link", "add", OTHER_CHANNEL, "type", "vcan")
        bring_up(OTHER_CHANNEL)
        wait_until(lambda: rules() == before, "the rules to be there again")
        assert node.stop() == 0


WITHOUT_RIGHTS = ("setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin")


def test_node_carries_frames_without_cap_net_admin(start_gateway: StartNode, here: Recording, there: Recording) -> None:
    with start_gateway(by=WITHOUT_RIGHTS) as node:
        with noise(50):
            pass
        assert rules() == []
        assert len(there.wait_for(NOISE, 50)) == len(here.wait_for(BACK, 50)) == 50
        assert node.stop() == 0
    why = "the kernel carries no frames (CAP_NET_ADMIN is needed), so this program carries them all, and they stop when"
    assert f"vcan0 and vcan1: {why} it does" in node.messages


def test_node_carries_frames_without_module_can_gw(start_gateway: StartNode, there: Recording) -> None:
    run_tool("rmmod", "can-gw")
    try:
        with start_gateway() as node:
            send(f"{NOISE:X}#01")
            there.wait_for(NOISE, 1)
            assert node.stop() == 0
    finally:
        module = f"/usr/lib/uml/modules/{os.uname().release}/kernel/net/can/can-gw.ko"
        run_tool(*(("insmod", module) if Path(module).exists() else ("modprobe", "can-gw")))
    assert "the kernel carries no frames (its module can-gw is needed)" in node.messages


def test_gateway_refuses_to_start_if_rules_are_left_that_it_cannot_change(start_gateway: StartNode) -> None:
    with start_gateway() as node:
        node.stop(signal.SIGKILL)
    words = "an earlier gateway left rules in the kernel, which only CAP_NET_ADMIN may change"
    with pytest.raises(AssertionError, match=words), start_gateway(by=WITHOUT_RIGHTS):
        pass  # it refuses to start
    assert len(rules()) == RULES, "others are still carried"


def test_internal_error_leaves_the_kernel_rules_in_place() -> None:
    routes = KernelRoutes((CHANNEL, OTHER_CHANNEL), {(BATTERY, False)}, fd=False, say=print)
    with suppress(ZeroDivisionError), routes:
        routes.set()
        raise ZeroDivisionError
    assert len(rules()) == 2 * (11 + 1)


def test_rules_for_a_vanished_interface_are_refused_in_one_line() -> None:
    run_tool("ip", "link", "add", "vcan9", "type", "vcan")
    with KernelRoutes((CHANNEL, "vcan9"), {(BATTERY, False)}, fd=False, say=print) as routes:
        run_tool("ip", "link", "delete", "vcan9")
        with pytest.raises(BusError, match=r"^vcan0 and vcan9: the kernel refuses a rule of can-gw: no interface"):
            routes.set()


def test_foreign_frames_are_dropped(drive: Path, start_gateway: StartNode, here: Recording, there: Recording) -> None:
    command = ["cangen", OTHER_CHANNEL, "-I", f"{BATTERY:X}", "-D", FOREIGN, "-L", "8", "-g", "1"]
    with start_gateway() as node:
        with subprocess.Popen(command) as foreigner:
            with playing(drive) as player:
                state = State.CORRECTING, Reason.FOREIGN_FRAMES
                wait_until(lambda: state_of(there.data_of(STATUS)[-1]) == state, "the state FOREIGN_FRAMES")
                assert player.wait(LONGEST_WAIT_S) == 0
            foreigner.terminate()
        here.wait_for(BATTERY, INSTANTS)
        there.wait_for(AUXILIARY, INSTANTS)
        assert node.stop() == 0
    foreign = bytes.fromhex(FOREIGN)
    assert foreign not in here.data_of(BATTERY), "none reaches the sensors' bus"
    passed = [data for data in there.data_of(BATTERY) if data != foreign]
    assert [data[1] & 15 for data in passed] == [k % 15 for k in range(INSTANTS)], "each frame of the branch arrives"
    assert passed != here.data_of(BATTERY), "corrected"
    words = "vcan1': another node sends frames 0x110, which only this one may send there; they are dropped"
    assert words in node.messages


def test_gateway_whose_standard_error_nobody_reads_forwards_frames_and_can_be_ended(
    database: VehicleDatabase, params: Path, drive: Path, here: Recording, there: Recording
) -> None:
    read, write = os.pipe()
    os.set_blocking(write, False)
    try:
        while True:
            os.write(write, bytes(1 << 12))
    except BlockingIOError:
        os.set_blocking(write, True)
    command = [*ECU_NODE, "run", "--channel", CHANNEL, "--unsigned", "--params", str(params), *GATEWAY]
    with subprocess.Popen([*command, "--layout", str(database.layout.path)], stderr=write) as process:
        try:
            there.wait_for(STATUS, 1)
            with noise(100), playing(drive) as player:
                generate(OTHER_CHANNEL, 20, "-I", f"{BATTERY:X}")  # each is worth a line
                assert player.wait(LONGEST_WAIT_S) == 0
            there.wait_for(AUXILIARY, INSTANTS)
            there.wait_for(NOISE, 100)
            here.wait_for(BACK, 100)
            process.terminate()
            assert process.wait(LONGEST_WAIT_S) == 0
        finally:
            process.kill()
            os.close(write)
            os.close(read)
    assert rules() == []


@contextmanager
def joined() -> Iterator[None]:
    """Both buses as one, as by a cable: each frame of one is sent anew on the other."""
    ends = [socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) for _ in range(2)]
    ended = threading.Event()

    def carry(source: socket.socket, target: socket.socket) -> None:
        while not ended.is_set():
            with suppress(OSError):  # nothing was received, or the queue is full
                target.send(source.recv(16))

    for end, channel in zip(ends, (CHANNEL, OTHER_CHANNEL), strict=True):
        end.bind((channel,))
        end.settimeout(0.1)
    threads = [threading.Thread(target=carry, args=pair) for pair in (ends, ends[::-1])]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()
        for end in ends:
            end.close()


@pytest.mark.parametrize("killed", [False, True], ids=["gateway running", "gateway killed before"])
def test_joined_buses_stop_the_gateway(drive: Path, tmp_path: Path, start_gateway: StartNode, killed: bool) -> None:
    words = "which only this one may send there; two nodes on one bus, or two buses that are joined? Stop one"
    with start_gateway() as node:
        if killed:
            node.stop(signal.SIGKILL)
        with joined(), playing(drive, endlessly=True):
            if killed:
                with pytest.raises(AssertionError, match=re.escape(words)), start_gateway():
                    pass  # it hears the branches where only it may send them, and removes what the first one left
            else:
                assert node.process.wait(LONGEST_WAIT_S) == 1
                assert words in node.messages
            assert rules() == []
    with joined(), running_recording(tmp_path / "after.log", OTHER_CHANNEL) as after:
        send(f"{NOISE:X}#01")
        after.wait_for(NOISE, 1)
        time.sleep(0.5)
        assert len(after.data_of(NOISE)) == 1, "nothing goes round"
