"""One parameter file to be exported, checked as the node checks it before it corrects anything."""

from dataclasses import dataclass
from pathlib import Path

from ecu_node.bus.wiring import InForce, sensor_fault
from ecu_node.core.correction import SensorFault
from ecu_node.database import VehicleDatabase
from ecu_node.documents import text_digest
from ecu_node.errors import ParameterError
from ecu_node.parameters import VehicleParameters, check_fit, decode_parameters, parameter_bytes

__all__ = ["Checked", "read_checked"]


@dataclass(frozen=True, kw_only=True)
class Checked:
    """Parameters that fit, and what they fit.

    Attributes
    ----------
    name : str
        Name of the parameter file.
    digest : str
        SHA-256 of the file as it was read, line ends counted as LF.
    parameters : VehicleParameters
        What it says.
    database : VehicleDatabase
        Layout and DBC that it was made for.
    """

    name: str
    digest: str
    parameters: VehicleParameters
    database: VehicleDatabase

    @property
    def provenance(self) -> dict[str, str]:
        """Where it comes from, by short names that are the same in all formats."""
        parameters = self.parameters
        return {
            "vehicle": parameters.vehicle,
            "parameter_set": str(parameters.number),
            "verdict": parameters.verdict,
            "tool": parameters.provenance.tool,
            "method": parameters.provenance.method,
            "created": parameters.provenance.created,
            "fleet": parameters.provenance.fleet,
            "parameters_sha256": self.digest,
            "layout_sha256": parameters.layout.sha256,
            "dbc_sha256": parameters.dbc.sha256,
        }

    def fault(self, branch: str) -> SensorFault:
        """What the node corrects on a branch; :data:`~ecu_node.core.correction.NO_FAULT` where it passes it through."""
        return sensor_fault(InForce(parameters=self.parameters), branch)


def read_checked(path: Path, database: VehicleDatabase, vehicle: str | None) -> Checked:
    """Read a parameter file and refuse what the node would not apply.

    Parameters
    ----------
    path : Path
        The file.
    database : VehicleDatabase
        Layout and DBC in use.
    vehicle : str or None
        Identity of the vehicle; None: not checked.

    Returns
    -------
    Checked
        Parameters that fit.

    Raises
    ------
    ParameterError
        If the file cannot be read, or its parameters are for another vehicle, layout or DBC, or implausible.
    """
    content = parameter_bytes(path)
    parameters = decode_parameters(content, str(path))
    try:
        check_fit(parameters, database, vehicle)
    except ParameterError as error:
        raise ParameterError(f"{path}: {error}") from None
    return Checked(name=path.name, digest=text_digest(content), parameters=parameters, database=database)
