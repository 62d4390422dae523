"""Results of worker processes come in order; a worker that is replaced is nothing to warn of (warnings are errors)."""

import warnings

import pytest
from joblib import delayed

from calibrator.processes.computing import in_processes

REPLACED = (
    "A worker stopped while some jobs were given to the executor. This can be caused by a too short worker timeout or "
    "by a memory leak."
)


def test_a_worker_that_is_replaced_is_nothing_to_warn_of() -> None:
    assert list(in_processes((delayed(abs)(number) for number in (-1, 2, -3)), workers=1)) == [1, 2, 3]
    warnings.warn(REPLACED, UserWarning, stacklevel=1)
    with pytest.raises(UserWarning, match="something else"):
        warnings.warn("something else", UserWarning, stacklevel=1)
