"""Signed files: what was signed is read back, by a reader of somebody else too, and nothing else is."""

import base64
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from securesystemslib.dsse import Envelope as DsseEnvelope

from ecu_node.core.status import Reason, TrustError
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.canonical import canonical_bytes, read_canonical
from ecu_node.trust.envelope import read_envelope
from ecu_node.trust.key_set import KEY_SET, KeySet, PublicKey, check_key_set
from ecu_node.trust.statements import PARAMETERS_TYPE, Revocation, SignedParameters, open_statement, verify
from tests.trust.signing import Signers


@pytest.fixture(scope="module")
def content(signers: Signers, parameters: VehicleParameters) -> bytes:
    return signers.parameters(parameters, 7)


def test_what_was_signed_is_read_back_with_the_names_of_the_signers(
    content: bytes, signers: Signers, parameters: VehicleParameters
) -> None:
    found = verify(content, signers.keys(), "f")
    assert isinstance(found.statement, SignedParameters)
    assert found.statement.parameters == parameters
    assert found.statement.sequence == 7
    assert sorted(found.signers) == ["a", "b"]


def test_securesystemslib_reads_and_verifies_the_same_file(content: bytes, signers: Signers) -> None:
    envelope = DsseEnvelope.from_dict(json.loads(content))
    accepted = envelope.verify([signers.signers[name].public_key for name in "ab"], 2)
    assert len(accepted) == 2
    assert json.loads(envelope.payload)["sequence"] == 7


def test_no_byte_can_be_another_one(content: bytes, signers: Signers) -> None:
    keys = signers.keys()
    for place in range(len(content)):
        flipped = bytearray(content)
        flipped[place] ^= 0x01
        with pytest.raises(TrustError):
            verify(bytes(flipped), keys, "f")


def test_no_bit_of_a_signature_can_be_another_one(content: bytes, signers: Signers) -> None:
    document = json.loads(content)
    for bit in range(512):
        signature = bytearray(base64.b64decode(document["signatures"][0]["sig"]))
        signature[bit // 8] ^= 1 << bit % 8
        document["signatures"][0]["sig"] = base64.b64encode(signature).decode()
        with pytest.raises(TrustError, match=r"the signature of . is wrong"):
            verify(canonical_bytes(document) + b"\n", signers.keys(), "f")
        document = json.loads(content)


def test_no_file_that_ends_early_or_late_is_taken(content: bytes, signers: Signers) -> None:
    for length in range(len(content)):
        with pytest.raises(TrustError):
            verify(content[:length], signers.keys(), "f")
    for more in (b"\n", b" ", b"\x00", content):
        with pytest.raises(TrustError):
            verify(content + more, signers.keys(), "f")


@pytest.mark.parametrize(
    ("by", "keys", "words"),
    [
        ("a", "abc", "signed by a; 2 signers are needed"),
        ("ad", "abc", "which is not trusted here"),
        ("abd", "abc", "which is not trusted here"),
        ("ab", "c", "which is not trusted here"),
    ],
)
def test_too_few_or_unknown_signers_are_refused(
    signers: Signers, parameters: VehicleParameters, by: str, keys: str, words: str
) -> None:
    content = signers.parameters(parameters, 7, by=by)
    with pytest.raises(TrustError, match=words) as caught:
        verify(content, signers.keys(keys, threshold=min(2, len(keys))), "f")
    assert caught.value.reason is Reason.NOT_SIGNED


def test_one_signer_does_not_count_twice(content: bytes, signers: Signers) -> None:
    document = json.loads(content)
    first = document["signatures"][0]
    for twice in ([first, first], [first, {**first, "keyid": document["signatures"][1]["keyid"]}]):
        document["signatures"] = twice
        with pytest.raises(TrustError):
            verify(canonical_bytes(document) + b"\n", signers.keys(), "f")


def test_a_statement_of_one_kind_is_not_taken_for_another(content: bytes, signers: Signers) -> None:
    document = json.loads(content)
    document["payloadType"] = document["payloadType"].replace("parameters", "revocation")
    with pytest.raises(TrustError, match="is wrong: the file was changed"):
        verify(canonical_bytes(document) + b"\n", signers.keys(), "f")


def nested(depth: int) -> bytes:
    return b"[" * depth + b"]" * depth + b"\n"


@pytest.mark.parametrize(
    "strange",
    [
        b"",
        b"\n",
        b"{}\n",
        b"null\n",
        b"[]\n",
        b'{"payload":NaN}\n',
        b'{"payload":Infinity}\n',
        b"\xff\xfe\n",
        b"\x80abc\n",
        nested(10),
        nested(100_000),
        b'{"a":' * 50_000 + b"1" + b"}" * 50_000 + b"\n",
        b"9" * 5000 + b"\n",
        b"1e999\n",
        b'"\\ud800"\n',
    ],
    ids=lambda text: repr(text[:12]),
)
def test_strange_files_are_one_line(strange: bytes, signers: Signers) -> None:
    with pytest.raises(TrustError, match=r"^f: [^\n]*$") as caught:
        verify(strange, signers.keys(), "f")
    assert caught.value.reason is Reason.MALFORMED_PARAMETERS


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"signatures":', b'"signatures": '),
        (b'{"payload"', b'{"payload":"","payload"'),
        (b'"payloadType"', b'"extra":1,"payloadType"'),
    ],
)
def test_an_envelope_in_other_words_is_refused(content: bytes, signers: Signers, old: bytes, new: bytes) -> None:
    assert old in content
    with pytest.raises(TrustError):
        verify(content.replace(old, new, 1), signers.keys(), "f")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"sequence":7', b'"sequence":7.0'),
        (b'"sequence":7', b'"sequence":7,"sequence":7'),
        (b'"sequence":7', b'"sequence": 7'),
        (b'"sequence":7', b'"sequence":9007199254740993'),
        (b'"drift":0.05', b'"drift":5e-2'),
        (b'"drift":0.05', b'"drift":NaN'),
        (b'"vehicle":"v1"', b'"vehicle":"\\u0076\\u0031"'),
        (b'"vehicle":"v1"', b'"vehicle":"v\xff"'),
    ],
)
def test_content_in_other_words_is_refused_even_if_it_is_signed(
    content: bytes, signers: Signers, old: bytes, new: bytes
) -> None:
    payload = base64.b64decode(json.loads(content)["payload"])
    assert old in payload
    envelope = DsseEnvelope(payload.replace(old, new, 1), PARAMETERS_TYPE, {})
    for signer in signers.of("ab"):
        envelope.sign(signer)
    text = {"signatures": sorted(envelope.to_dict()["signatures"], key=lambda item: item["keyid"])}
    with pytest.raises(TrustError, match="signed content"):
        verify(canonical_bytes(envelope.to_dict() | text) + b"\n", signers.keys(), "f")


def test_an_unknown_kind_is_named(signers: Signers) -> None:
    envelope = DsseEnvelope(b"{}", "text/plain", {})
    envelope.sign(signers.signers["a"])
    with pytest.raises(TrustError, match="a statement of kind 'text/plain'; this version knows"):
        open_statement(canonical_bytes(envelope.to_dict()) + b"\n", "f")


@given(data=st.data())
@settings(max_examples=300, deadline=None)
def test_files_that_a_fuzzer_changed_are_never_taken(content: bytes, signers: Signers, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(content)))
    stop = data.draw(st.integers(start, min(len(content), start + 20)))
    changed = content[:start] + data.draw(st.binary(max_size=20)) + content[stop:]
    if changed != content:
        with pytest.raises(TrustError):
            verify(changed, signers.keys(), "f")


def test_key_sets_that_cannot_work_are_refused(signers: Signers) -> None:
    with pytest.raises(TrustError, match="4 signers are needed, and 3 keys are there"):
        check_key_set(signers.keys(threshold=4), "k")
    one = signers.public["a"].key
    twice = KeySet(version=1, threshold=2, keys={"x": one, "y": PublicKey(name="b", ed25519=one.ed25519)})
    with pytest.raises(TrustError, match="a key stands there twice"):
        check_key_set(twice, "k")
    named = KeySet(version=1, threshold=2, keys={"x": one, "y": PublicKey(name="a", ed25519="0" * 64)})
    with pytest.raises(TrustError, match="a stands there with two keys"):
        check_key_set(named, "k")


def test_a_key_has_one_spelling(signers: Signers) -> None:
    """Else one key could stand in a set twice, and its owner count for two."""
    content = canonical_bytes(signers.keys())
    key = signers.public["a"].key.ed25519
    for other in (key + "\\n", key.upper(), f"{key[:2]} {key[2:]}"):
        with pytest.raises(TrustError, match="not a key set"):
            read_canonical(content.replace(key.encode(), other.encode()), KeySet, "k", KEY_SET)


def test_a_revocation_says_what_it_revokes(signers: Signers) -> None:
    content = signers.revocation(9, 7, 8)
    found = verify(content, signers.keys(), "f").statement
    assert isinstance(found, Revocation)
    assert (found.sequence, found.revokes) == (9, [7, 8])
    assert read_envelope(content, "f").payloadType.endswith("revocation+json")
