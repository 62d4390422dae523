"""Where a DBC has room for corrected values: signals named as a branch's own, with *corrected* or *quality*."""

from collections.abc import Sequence
from dataclasses import dataclass

from calibrator.doctor.words import words_of
from calibrator.proposal.branches import ProposedBranch
from calibrator.proposal.signals import Candidate

__all__ = ["ProposedTarget", "checked_messages", "propose_targets"]

CHECKS = frozenset({"crc", "checksum", "crc8", "chk"})
"""Words of the signal that protects a message."""


@dataclass(frozen=True, kw_only=True)
class ProposedTarget:
    """Where the corrected value of a branch goes, and its quality, if that has a signal."""

    corrected: str
    quality: str | None


def propose_targets(found: Sequence[Candidate], branches: Sequence[ProposedBranch]) -> dict[str, ProposedTarget]:
    """Find signals for corrected values.

    Parameters
    ----------
    found : sequence of Candidate
        All signals of the DBC: no log has them before the node runs.
    branches : sequence of ProposedBranch
        The branches.

    Returns
    -------
    dict of str to ProposedTarget
        By branch; only those in messages that another control unit sends than the branch's own.
    """
    by_words = {frozenset(words_of(item.signal.name)): item for item in found}
    targets: dict[str, ProposedTarget] = {}
    for branch in branches:
        own = frozenset(words_of(branch.signal.signal.name))
        corrected = by_words.get(own | {"corrected"})
        if corrected is None or set(corrected.message.senders) & set(branch.signal.message.senders):
            continue
        quality = by_words.get(own | {"quality"})
        if quality is not None and quality.message.name != corrected.message.name:
            quality = None
        targets[branch.name] = ProposedTarget(
            corrected=corrected.name, quality=quality.name if quality is not None else None
        )
    return targets


def checked_messages(branches: Sequence[ProposedBranch]) -> list[str]:
    """Messages of the branches that seem to be protected end to end."""
    return list(
        dict.fromkeys(
            branch.signal.message.name
            for branch in branches
            if any(CHECKS & set(words_of(signal.name)) for signal in branch.signal.message.signals)
        )
    )
