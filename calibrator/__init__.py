"""Learn from recorded drives what each vehicle's high-voltage current sensors do wrong.

A fleet of twelve vehicles, given as data frames with currents in A, positive into the junction:

    from calibrator import Fleet, FleetCalibrator, Junction

    junction = Junction(branches=["battery", "motor"], full_scale_a=400.0)
    fleet = Fleet.from_frames({"V1": frame, "V2": frames, ...}, junction, inputs=["speed", "torque"])
    found = FleetCalibrator().fit(fleet)
    found.parameters_

One car with a sensor that is trusted needs no fleet:

    JunctionCalibrator(trusted=["battery"]).fit(frame, junction).parameters_

Importing the package is quick; modules that take time are imported on first use.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calibrator.estimator.fleet import Fleet, FleetCalibrator, JunctionCalibrator, read_log
    from calibrator.estimator.frames import Junction

__all__ = ["Fleet", "FleetCalibrator", "Junction", "JunctionCalibrator", "read_log"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'calibrator' has no attribute {name!r}; it offers {', '.join(__all__)}")
    from calibrator.estimator import fleet  # noqa: PLC0415 (so that other commands need not wait for it)

    return getattr(fleet, name)


def __dir__() -> list[str]:
    return __all__
