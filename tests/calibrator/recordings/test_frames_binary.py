import gzip
from pathlib import Path

import numpy as np
import pytest

from calibrator.errors import LogError
from calibrator.recordings.frames import read_frames


@pytest.mark.parametrize("suffix", [".asc", ".trc", ".asc.gz"])
def test_binary_data_under_the_name_of_a_text_log_is_not_called_empty(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"noise{suffix}"
    noise = np.random.default_rng(1).bytes(5000)
    path.write_bytes(gzip.compress(noise) if suffix.endswith(".gz") else noise)
    with pytest.raises(LogError, match=rf"noise{suffix}: not a {suffix[:4]} log but binary data; give the file"):
        read_frames(path)


def test_letters_beyond_ascii_are_text(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    path.write_bytes("date Mo. M\xe4r 2 10:00:00 2026\r\nbase hex  timestamps absolute\r\n".encode("latin-1"))
    with pytest.raises(LogError, match="the log is empty: no data frames"):
        read_frames(path)
