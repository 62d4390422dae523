"""Whom a vehicle trusts changes only by the word of those whom it trusts, and of those who are to come."""

import base64
import json
from datetime import timedelta
from pathlib import Path

import pytest

from ecu_node.core.status import Reason, TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.activation import accept
from ecu_node.trust.canonical import canonical_bytes
from ecu_node.trust.judgement import Accepted
from ecu_node.trust.state import read_state
from tests.trust.signing import NOW, Signers


def take(state: Path, content: bytes, database: VehicleDatabase) -> Accepted:
    return accept(state, content, "f", database, NOW + timedelta(hours=1))


def test_keys_are_rotated_by_the_signers_of_before(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    for by, words in (("cd", "signed by c; 2 signers are needed"), ("d", "signed by nobody of them; 2 signers are")):
        with pytest.raises(TrustError, match=words):
            take(state, signers.key_set(signers.keys("acd", version=2), by=by), database)
    take(state, signers.key_set(signers.keys("acd", version=2), by="abc"), database)
    with pytest.raises(TrustError, match="which is not trusted here"):
        take(state, signers.parameters(parameters, 5, by="ab"), database)
    take(state, signers.parameters(parameters, 5, by="cd"), database)
    with pytest.raises(TrustError, match="signed by a; 2 signers are needed"):
        take(state, signers.key_set(signers.keys("abc", version=3), by="ab"), database)


def test_a_key_set_is_signed_by_enough_of_its_own_signers_too(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    """Else nobody might have the keys that every later file needs."""
    for names, by, words in (
        ("ad", "ab", "signed by 1 of the new set itself; 2 are needed"),
        ("ab", "abd", "which is not trusted here"),
    ):
        with pytest.raises(TrustError, match=words) as caught:
            take(state, signers.key_set(signers.keys(names, version=2), by=by), database)
        assert caught.value.reason is Reason.NOT_SIGNED
    assert "signed by a, b, d" in take(state, signers.key_set(signers.keys("ad", version=2), by="abd"), database).text
    assert read_state(state).keys.version == 2


def test_a_wrong_signature_of_a_newcomer_is_refused(state: Path, signers: Signers, database: VehicleDatabase) -> None:
    document = json.loads(signers.key_set(signers.keys("abd", version=2), by="abd"))
    keyid = signers.public["d"].keyid
    for item in document["signatures"]:
        if item["keyid"] == keyid:
            item["sig"] = base64.b64encode(bytes(64)).decode()
    with pytest.raises(TrustError, match="the signature of d is wrong"):
        take(state, canonical_bytes(document) + b"\n", database)
