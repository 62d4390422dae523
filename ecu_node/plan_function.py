"""A plan as a function of measured codes; whether it needs a voltage is asked once, when it is put in force."""

from collections.abc import Callable

from ecu_node.auxiliary import Auxiliary
from ecu_node.codes import Codes
from ecu_node.correction import IntegerPlan
from ecu_node.counters import Counters

__all__ = ["PlanFunction", "plan_function"]

PlanFunction = Callable[[int], int | None]
"""From a measured code to the one to write; None where there is none."""


def plan_function(codes: Codes, plan: IntegerPlan, voltage: Auxiliary | None, counters: Counters) -> PlanFunction:
    """Make the function; what it looks up in every frame is bound to it.

    Parameters
    ----------
    codes : Codes
        Of the measured signal.
    plan : IntegerPlan
        Correction in integers.
    voltage : Auxiliary or None
        Of a branch that is a power.
    counters : Counters
        Where results beyond the ends are counted.

    Returns
    -------
    callable
        Takes a measured code, and returns the one to write; None where the code, or a voltage, is no value.
    """
    if voltage is not None and plan.needs_voltage:
        return _with_voltage(codes, plan, voltage, counters)

    def fix(code: int) -> int | None:
        if not codes.is_value(code):
            return None
        counters.saturated += plan.saturates(code)
        return plan.apply(code)

    return fix


def _with_voltage(codes: Codes, plan: IntegerPlan, voltage: Auxiliary, counters: Counters) -> PlanFunction:
    def fix(code: int) -> int | None:
        if voltage.code is None or not codes.is_value(code):
            return None
        counters.saturated += plan.saturates(code, voltage.code)
        return plan.apply(code, voltage.code)

    return fix
