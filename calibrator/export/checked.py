"""One parameter file to be exported, checked as the node checks it before it corrects anything."""

from dataclasses import dataclass
from pathlib import Path

from ecu_node.bus.in_force import InForce, sensor_fault
from ecu_node.core.correction import NO_FAULT, SensorFault
from ecu_node.database import VehicleDatabase
from ecu_node.documents import text_digest
from ecu_node.errors import ParameterError, printable
from ecu_node.parameters import VehicleParameters, check_fit, decode_parameters, parameter_bytes
from ecu_node.trust.statements import SignedParameters, open_statement

__all__ = ["Checked", "read_checked"]

_SIGNED = b'{"payload":'
"""How a signed file begins: it is canonical JSON."""


@dataclass(frozen=True, kw_only=True)
class Checked:
    """Parameters that fit, and what they fit.

    Attributes
    ----------
    name : str
        Name of the parameter file.
    digest : str
        SHA-256 of the file as it was read, signed or not, line ends counted as LF.
    parameters : VehicleParameters
        What it says.
    database : VehicleDatabase
        Layout and DBC that it was made for.
    signed : SignedParameters or None
        The statement that the parameters were taken out of.
    """

    name: str
    digest: str
    parameters: VehicleParameters
    database: VehicleDatabase
    signed: SignedParameters | None = None

    @property
    def in_force(self) -> InForce:
        """The same as the node takes it."""
        return InForce(parameters=self.parameters)

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
        """What the node corrects on a branch; :data:`NO_FAULT` where it passes it through."""
        return sensor_fault(self.in_force, branch)

    def is_applied(self, branch: str) -> bool:
        """Whether the node corrects a branch."""
        return self.fault(branch) is not NO_FAULT

    def notices(self) -> list[str]:
        """What was not checked of the parameters, one line each."""
        if self.signed is None:
            return []
        return [
            f"{printable(self.name)}: signed, number {self.signed.sequence}, to hold from {self.signed.not_before} to "
            f"{self.signed.expires}; signatures, number and times were not checked, 'ecu-node verify' does"
        ]


def read_checked(path: Path, database: VehicleDatabase, vehicle: str | None) -> Checked:
    """Read a parameter file, signed or not, and refuse what the node would not apply. No signature is checked.

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
    signed = _signed(content, path) if content.startswith(_SIGNED) else None
    parameters = decode_parameters(content, str(path)) if signed is None else signed.parameters
    try:
        check_fit(parameters, database, vehicle)
    except ParameterError as error:
        raise ParameterError(f"{path}: {error}") from None
    return Checked(name=path.name, digest=text_digest(content), parameters=parameters, database=database, signed=signed)


def _signed(content: bytes, path: Path) -> SignedParameters:
    _, statement = open_statement(content, str(path))
    if not isinstance(statement, SignedParameters):
        raise ParameterError(f"{path}: signed, but no parameters: a revocation or a key set; name signed parameters")
    return statement
