"""Usage of tools/with_vcan; the tests in tests/vcan show what it does on its kernel."""

import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "tools" / "with_vcan"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(SCRIPT), *arguments], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("arguments", [[], ["--or-skip"], ["--nonsense", "true"], ["--or-skip", "--nonsense"]])
def test_with_vcan_exits_with_2_on_wrong_use(arguments: list[str]) -> None:
    result = run(*arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("usage: tools/with_vcan [--or-skip] COMMAND")
