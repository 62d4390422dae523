import base64
import gzip

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.report.packing import MISSING, Packed, pack


def unpacked(packed: Packed) -> dict[str, Array]:
    """What a page makes of it, value by value."""
    content = gzip.decompress(base64.b64decode(packed.data))
    found, start = {}, 0
    for column in packed.columns:
        length = int(column["length"])
        planes = [content[start + plane * length : start + (plane + 1) * length] for plane in range(4)]
        whole = [int.from_bytes(bytes(item), "little", signed=True) for item in zip(*planes, strict=True)]
        found[str(column["name"])] = np.array(
            [np.nan if item == MISSING else item * float(column["step"]) for item in whole]
        )
        start += 4 * length
    assert start == len(content)
    return found


def test_values_come_back_to_within_half_a_step() -> None:
    rng = np.random.default_rng(1)
    columns = {"a": (rng.normal(0.0, 100.0, (50, 3)), 1e-3), "b": (rng.uniform(-1.0, 1.0, 50), 1e-5)}
    found = unpacked(pack(columns))
    for name, (values, step) in columns.items():
        np.testing.assert_allclose(found[name], values.ravel(), atol=0.5001 * step)


def test_what_is_not_known_stays_unknown() -> None:
    found = unpacked(pack({"a": (np.array([1.0, np.nan, np.inf, -np.inf, 0.0]), 0.5)}))
    np.testing.assert_array_equal(found["a"], [1.0, np.nan, np.nan, np.nan, 0.0])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_values_beyond_the_range_are_held_at_its_end(sign: float) -> None:
    found = unpacked(pack({"a": (np.array([sign * 1e12]), 1.0)}))
    assert found["a"].tolist() == [sign * (2**31 - 1)]


def test_the_same_columns_give_the_same_text() -> None:
    columns = {"a": (np.arange(9.0), 1.0)}
    assert pack(columns) == pack(columns)


def test_no_vehicles_are_no_values() -> None:
    assert unpacked(pack({"a": (np.zeros((0, 2)), 1.0)}))["a"].size == 0
