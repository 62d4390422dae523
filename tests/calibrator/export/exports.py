"""Parameter files to export, and the node as a gateway to compare with."""

import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import pytest
from msgspec.structs import replace

from bench.c99_driver import COMPILER, CompiledExport, Frame, compile_export
from calibrator.export.checked import Checked, read_checked
from ecu_node.bus.guard import Mode, key_of
from ecu_node.bus.in_force import InForce
from ecu_node.bus.wiring import wire
from ecu_node.core.corrector import Corrector
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, VehicleParameters, write_parameters
from tests.ecu_node.vehicles import LAYOUT, parameters_for

needs_compiler = pytest.mark.skipif(shutil.which(COMPILER) is None, reason=f"no {COMPILER} to compile the export with")

MakeDatabase = Callable[..., VehicleDatabase]


def checked_with(database: VehicleDatabase, parameters: VehicleParameters, folder: Path) -> Checked:
    """Parameters written to a file and read as the export reads them."""
    write_parameters(parameters, folder / "v1.json")
    return read_checked(folder / "v1.json", database, None)


def held_back(parameters: VehicleParameters, name: str) -> VehicleParameters:
    """The same parameters, one branch not applied."""
    found = BranchParameters(drift=0.2, offset_a=7.0, drift_sd=0.01, apply=False, held_back="harm limit")
    return replace(parameters, branches={**parameters.branches, name: found})


def unprotected(folder: Path) -> VehicleDatabase:
    """The project's own layout without end-to-end protection, so that any frame is as good as any other."""
    text = LAYOUT.read_text()
    (folder / "hv_powertrain.toml").write_text(text[: text.index("[e2e]")])
    (folder / "hv_powertrain.dbc").write_bytes(LAYOUT.with_suffix(".dbc").read_bytes())
    return read_database(read_layout(folder / "hv_powertrain.toml"))


def compiled(
    database: VehicleDatabase, parameters: VehicleParameters, folder: Path, *, flags: Sequence[str] = ("-O2",)
) -> CompiledExport:
    """The export of these parameters, compiled."""
    return compile_export(checked_with(database, parameters, folder), folder, flags=flags)


def gateway(database: VehicleDatabase, parameters: VehicleParameters) -> Corrector:
    """The node's core with the same parameters."""
    return wire(database, InForce(parameters=parameters), start_s=0.0, mode=Mode.GATEWAY)


def by_the_node(database: VehicleDatabase, corrector: Corrector, frames: Iterable[Frame]) -> list[bytes]:
    """What the node passes on of frames that all come at one time."""
    keys = {message.name: key_of(message) for message in database.databases[""].messages}
    found = []
    for name, payload in frames:
        source = corrector.sources.get(keys[name])
        out = bytearray(payload) if source is None else source.forward(bytearray(payload), 0.0)
        assert out is not None
        found.append(bytes(out))
    return found


def assert_same(export: CompiledExport, frames: Sequence[Frame]) -> int:
    """Compare export and node frame by frame, and return how many were changed."""
    checked = export.program.checked
    wanted = by_the_node(checked.database, gateway(checked.database, checked.parameters), frames)
    found = export.frames(frames)
    for (name, payload), want, (got, changed) in zip(frames, wanted, found, strict=True):
        if (got, changed) != (want, want != payload):
            raise AssertionError(f"{name} {payload.hex()}: node {want.hex()}, C {got.hex()} (changed: {changed})")
    return sum(changed for _, changed in found)


__all__ = [
    "MakeDatabase",
    "assert_same",
    "by_the_node",
    "checked_with",
    "compiled",
    "gateway",
    "held_back",
    "needs_compiler",
    "parameters_for",
    "unprotected",
]
