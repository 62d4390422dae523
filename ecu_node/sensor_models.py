"""Sensor models that are not linear, as the parameter file carries them."""

from typing import Annotated

import msgspec

__all__ = ["GainBySign", "SensorModel", "TemperatureDrift"]

_Gain = Annotated[float, msgspec.Meta(gt=-1.0, lt=1.0)]
_Deviation = Annotated[float, msgspec.Meta(ge=0.0)]


class GainBySign(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="gain by sign"
):
    """Measured = (1 + drift of the true current's sign) * true + offset."""

    drift_positive: Annotated[_Gain, msgspec.Meta(description="relative gain error, current into the junction [1]")]
    drift_negative: Annotated[_Gain, msgspec.Meta(description="relative gain error, current out of the junction [1]")]
    difference_sd: Annotated[
        _Deviation | None, msgspec.Meta(description="standard deviation of their difference [1]")
    ] = None


class TemperatureDrift(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="temperature"
):
    """Measured = (1 + drift + drift_per_k * (temperature - reference_c)) * true + offset."""

    drift_per_k: Annotated[
        float, msgspec.Meta(gt=-1.0, lt=1.0, description="change of the branch's drift per kelvin [1/K]")
    ]
    reference_c: Annotated[float, msgspec.Meta(description="temperature at which the branch's drift holds [degC]")]
    drift_per_k_sd: Annotated[_Deviation | None, msgspec.Meta(description="standard deviation [1/K]")] = None


SensorModel = GainBySign | TemperatureDrift
"""Any of them."""
