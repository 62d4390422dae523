"""Parameters of a node: read at its start, used only if they fit; others may come in force while it runs."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ecu_node.bus.wiring import InForce, Mode, choose_parameters, put_in_force, wire
from ecu_node.core.status import Reason
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import write_parameters
from tests.ecu_node.vehicles import SMALL_DBC, MakeDatabase, parameters_for


@pytest.mark.parametrize(
    ("spoil", "reason", "words"),
    [
        *(
            (lambda whole, cut=cut: whole[:cut], Reason.MALFORMED_PARAMETERS, "not a parameter file")
            for cut in (0, 1, 300)
        ),
        (
            lambda whole: whole.replace(b'"v1"', b'"v2"'),
            Reason.WRONG_VEHICLE,
            "parameters are for vehicle 'v2', this is",
        ),
        (lambda _: None, Reason.NO_PARAMETERS, "no such parameter file; name one that is there"),
    ],
    ids=["empty", "one byte", "half written", "of another vehicle", "missing"],
)
def test_unfit_parameter_file_is_not_used(
    database: VehicleDatabase, tmp_path: Path, spoil: Callable[[bytes], bytes | None], reason: Reason, words: str
) -> None:
    """The node passes measured values through, and publishes why."""
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.25, 5.0)), path)
    if (content := spoil(path.read_bytes())) is None:
        path.unlink()
    else:
        path.write_bytes(content)
    in_force = choose_parameters(path, database, "v1")
    corrector = wire(database, in_force, 0.0)
    assert (corrector.branches[0].fault.drift, corrector.reason) == (0.0, reason)
    assert (in_force.why_not or "").startswith(f"{path}: {words}")


@pytest.mark.parametrize("mode", [Mode.OVERLAY, Mode.GATEWAY])
def test_changing_parameters_has_the_same_effect_as_starting_with_them(make_database: MakeDatabase, mode: Mode) -> None:
    """Measured and corrected signal have different scales here."""
    database = make_database(dbc=SMALL_DBC.replace("SG_ Battery : 0|16@1- (0.1,0)", "SG_ Battery : 0|16@1- (0.2,0)"))
    before, after = (
        InForce(parameters=parameters_for(database, **faults))
        for faults in ({"motor": (0.0, 1.0)}, {"battery": (0.125, 5.0)})
    )
    corrector, fresh = (wire(database, before, 0.0, mode=mode), wire(database, after, 2.0, mode=mode))
    put_in_force(corrector, database, after, 2.0, mode=mode)
    for live, new in zip(corrector.branches, fresh.branches, strict=True):
        assert (live.plan, live.fault) == (new.plan, new.fault)
        assert live.deadline_s == new.deadline_s
