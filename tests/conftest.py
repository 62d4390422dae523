"""What all tests share: real data where it is, the rule for skipped tests, a guard against open buses, Ctrl-C, ids."""

import os
import signal
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any
from weakref import WeakSet

import pytest
from hypothesis import settings

from ecu_node.program import load_python_can

load_python_can()  # before the first import of it, which would bring pandas into each process of the tests
import can  # noqa: E402

from ecu_node.database import VehicleDatabase, read_database  # noqa: E402
from ecu_node.layout import read_layout  # noqa: E402
from tests.ecu_node.vehicles import LAYOUT, SMALL_DBC, SMALL_LAYOUT, MakeDatabase  # noqa: E402

ROOT = Path(__file__).parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"
WHEN_ASKED = [ROOT / "tests" / name for name in ("package", "vcan")]
"""Folders whose tests run only where they are named: they need a built wheel, or a kernel with SocketCAN."""
LONGEST_ID = 60
"""Most characters of a parameter that is shown in the name of a test."""
NOTHING_MAY_BE_SKIPPED = os.environ.get("HV_REQUIRE_ALL") == "1"

settings.register_profile("patient", deadline=None)  # a busy machine or a first compilation may be slow
settings.load_profile("patient")

_buses: WeakSet[can.BusABC] = WeakSet()
_bus_init = can.BusABC.__init__


def _init(self: can.BusABC, *arguments: Any, **options: Any) -> None:
    _bus_init(self, *arguments, **options)
    _buses.add(self)


can.BusABC.__init__ = _init  # type: ignore[method-assign]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real recordings, which are not part of the repository."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no real recordings in {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session")
def database() -> VehicleDatabase:
    """The project's own layout and DBC."""
    return read_database(read_layout(LAYOUT))


@pytest.fixture
def make_database(tmp_path: Path) -> MakeDatabase:
    """A database from the texts of layout and DBC."""

    def make(layout: str = SMALL_LAYOUT, dbc: str = SMALL_DBC) -> VehicleDatabase:
        (tmp_path / "small.toml").write_text(layout)
        (tmp_path / "small.dbc").write_text(dbc)
        return read_database(read_layout(tmp_path / "small.toml"))

    return make


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    """A channel of python-can's virtual bus, named after the test."""
    return str(request.node.name)


@pytest.fixture(autouse=True)
def no_bus_left_open() -> Iterator[None]:
    """Fail a test that leaves a bus open: its frames would reach the next one."""
    before = set(_buses)
    yield
    left = {bus for bus in set(_buses) - before if not bus._is_shutdown}
    for bus in left:
        bus.shutdown()
    assert not left, f"buses left open: {left}"


def pytest_configure() -> None:
    """Let Ctrl-C end the tests and programs that they start: a shell lets jobs in the background ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Show a parameter that is no text with its name, as ``load_a=3``: a report then says what its numbers are."""
    if isinstance(val, str | set | frozenset):  # the order of a set is another one in each process
        return None
    text = val.name if isinstance(val, Enum) else repr(val)
    return f"{argname}={text}" if "<" not in text and len(text) <= LONGEST_ID else None  # <...> holds an address


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not collect tests that run only on request, so that they need not skip."""
    if collection_path not in WHEN_ASKED:
        return None
    asked = [(config.invocation_params.dir / argument.partition("::")[0]).resolve() for argument in config.args]
    return None if any(path.is_relative_to(collection_path) for path in asked) else True


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a run in which a test was skipped though HV_REQUIRE_ALL=1 says that all must run."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or not NOTHING_MAY_BE_SKIPPED:
        return
    skipped = reporter.stats.get("skipped", [])
    if skipped and session.exitstatus == pytest.ExitCode.OK:
        reporter.write_line(f"HV_REQUIRE_ALL=1, but {len(skipped)} tests were skipped", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
