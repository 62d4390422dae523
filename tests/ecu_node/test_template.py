"""``ecu-node template``: what it prints fits at once, and once filled in it is applied."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from ecu_node.bus.wiring import InForce, key_of, wire
from ecu_node.cli import run_ecu_node, template_text
from ecu_node.core.status import Reason, State
from ecu_node.parameters import check_fit, decode_parameters
from tests.ecu_node.vehicles import LAYOUT, SMALL_LAYOUT, Frame, MakeDatabase, answers

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


def check(params: Path) -> list[str]:
    return ["check", "--params", str(params), "--layout", str(LAYOUT), "--vehicle", "my car", "--json"]


def test_template_fits_its_layout_and_corrects_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_ecu_node(["template", "--layout", str(LAYOUT), "--vehicle", "my car"]) == 0
    (tmp_path / "V.json").write_text(capsys.readouterr().out)
    assert run_ecu_node(check(tmp_path / "V.json")) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["vehicle"], report["warnings"]) == ("my car", [])
    assert [branch["applied"] for branch in report["branches"].values()] == [False] * len(report["branches"])


@pytest.mark.parametrize(
    ("load", "expected_a", "state"),
    [
        ("[unmeasured_load]\nmean_a = 6.1\nsd_a = 1.0\n", 6.1, (State.CORRECTING, Reason.NONE)),
        ("", 0.0, (State.PASSING_THROUGH, Reason.CORRECTION_WORSE)),
    ],
)
def test_sum_is_judged_about_the_declared_load(
    make_database: MakeDatabase, load: str, expected_a: float, state: tuple[State, Reason]
) -> None:
    """The battery shows 4 A too little and feeds a load of 6.1 A that no branch measures: about 0 A it looks better."""
    database = make_database(f"{SMALL_LAYOUT}{load}")
    document = json.loads(template_text(database, "v1", NOW))
    assert document["junction_residual"]["expected_a"] == expected_a
    document["branches"]["battery"] = {"drift": 0.0, "offset_a": -4.0, "apply": True}
    del document["branches"]["heater"]
    parameters = decode_parameters(json.dumps(document).encode(), "t")
    check_fit(parameters, database, "v1")
    corrector = wire(database, InForce(parameters=parameters), 0.0)
    pair = database.message("Pair")
    for step in range(300):
        data = pair.encode({"Battery": 20.0 + 6.1 - 4.0 + step % 2, "Motor": 20.0 + step % 2})
        answers(corrector, Frame(key_of(pair), data), 0.05 * step)
        corrector.look(0.05 * step)
    assert corrector.state() == state


def test_template_refuses_load_beyond_limits(make_database: MakeDatabase, capsys: pytest.CaptureFixture[str]) -> None:
    database = make_database(f"{SMALL_LAYOUT}\nunmeasured_load = {{ mean_a = 200.0, sd_a = 1.0 }}\n")
    assert run_ecu_node(["template", "--layout", str(database.layout.path), "--vehicle", "v1"]) == 1
    assert "[unmeasured_load] mean_a = 200 is beyond the layout's limit of 160 A" in capsys.readouterr().err
