"""What 'calibrator sign' makes of one file, so that the same command, run again, goes on where it was interrupted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from securesystemslib.signer import Signer

from calibrator.errors import ContradictionError, SigningError
from calibrator.signing.numbers import time_text
from calibrator.signing.statements import signed_anew, signed_statement
from ecu_node.core.status import TrustError
from ecu_node.parameters import VehicleParameters, read_parameters
from ecu_node.trust.canonical import read_bytes
from ecu_node.trust.envelope import Envelope
from ecu_node.trust.statements import SignedParameters, instant, open_statement

__all__ = ["Order"]

_DAYS = 365
_SAME_WORK = timedelta(days=1)
"""A command that is run again within this time goes on; later, files are to be signed anew."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """How files are to be signed.

    Attributes
    ----------
    signers : sequence of Signer
        Who signs.
    now : datetime
        The time, in whole seconds.
    sequence : int or None
        Number of all of them; None: the time in seconds.
    days : int or None
        How long they hold [d]; None: 365.
    allow_large_step : bool
        Whether they may differ a lot from what is in force.
    """

    signers: Sequence[Signer]
    now: datetime
    sequence: int | None
    days: int | None
    allow_large_step: bool

    def signed(self, path: Path) -> bytes:
        """Sign a file.

        Parameters
        ----------
        path : Path
            A parameter file, or a signed file that gets more signatures.

        Returns
        -------
        bytes
            Text of the signed file, which can be read again.

        Raises
        ------
        ContradictionError
            If it is signed already, and number or times were given.
        SigningError
            If no vehicle could read it signed.
        ParameterError
            If it is no parameter file.
        """
        before = self._signed_before(path)
        return self._with_more(path, before) if before is not None else self._at(path, read_parameters(path), self.now)

    def is_done(self, path: Path, place: Path) -> bool:
        """Whether the signed file of a file stands in its place: what this order makes now, or made within a day.

        Parameters
        ----------
        path, place : Path
            The file, and where it is to be when it is signed.

        Returns
        -------
        bool
            False also if something else stands there. Raises as :meth:`signed`.
        """
        try:
            there = read_bytes(place)
            _, statement = open_statement(there, str(place))
        except TrustError:
            return False
        before = self._signed_before(path)
        if before is not None:
            return self._with_more(path, before) == there
        if not isinstance(statement, SignedParameters):
            return False
        begun = instant(statement.not_before, str(place))
        is_recent = timedelta(0) <= self.now - begun < _SAME_WORK
        return is_recent and self._at(path, read_parameters(path), begun) == there

    def _signed_before(self, path: Path) -> Envelope | None:
        """Return what is signed already; None if it is a parameter file, or nothing of either kind."""
        try:
            envelope, _ = open_statement(read_bytes(path), str(path))
        except TrustError:
            return None
        if self.sequence is not None or self.days is not None or self.allow_large_step:
            raise ContradictionError(
                f"{path}: it is signed already, and can only be signed by one more; leave --sequence, --days and "
                f"--allow-large-step out, or sign the parameter file"
            )
        return envelope

    def _with_more(self, path: Path, before: Envelope) -> bytes:
        return _readable(path, lambda: signed_anew(before, self.signers))

    def _at(self, path: Path, parameters: VehicleParameters, when: datetime) -> bytes:
        statement = SignedParameters(
            sequence=self.sequence or int(when.timestamp()),
            not_before=time_text(when),
            expires=time_text(when + timedelta(days=self.days or _DAYS)),
            allow_large_step=self.allow_large_step,
            parameters=parameters,
        )
        return _readable(path, lambda: signed_statement(statement, self.signers))


def _readable(path: Path, sign: Callable[[], bytes]) -> bytes:
    """A signed file that can be read again."""
    try:
        content = sign()
        open_statement(content, "signed")
    except TrustError as error:
        raise SigningError(f"{path}: no vehicle could read this signed: {error}") from None
    return content
