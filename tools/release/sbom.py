"""Bills of materials of what is installed, as CycloneDX JSON: of the node alone, and with all that users may add.

    cd tools && python -m release.sbom [../dist]

They tell the pinned packages on this kind of machine, with their licences and which of them needs which.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

from ecu_node import __version__
from release.clean_venv import ROOT, CleanVenv, new_venv, the_wheel

__all__ = ["BILLS", "bill_of", "main"]

BILLS = {"node": (), "all": ("calibrator", "cluster", "demo", "metrics", "mf4")}
"""Name of each bill, and the extras in it."""
_NAME = "hv-current-correction"
_VERSION = SchemaVersion.V1_6


def bill_of(venv: CleanVenv, wheel: Path) -> str:
    """Make the bill of materials of an environment.

    Parameters
    ----------
    venv : CleanVenv
        In which the wheel is installed.
    wheel : Path
        Of which the digest is told.

    Returns
    -------
    str
        CycloneDX JSON, valid; the same for the same packages.

    Raises
    ------
    SystemExit
        If it is not valid, or names a file of this machine.
    """
    options = ("--pyproject", str(ROOT / "pyproject.toml"), "--short-PURLs", "--output-reproducible")
    command = [sys.executable, "-m", "cyclonedx_py", "environment", *options, "--sv", _VERSION.to_version()]
    done = subprocess.run([*command, venv.program("python")], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"sbom: cyclonedx-py failed: {done.stderr.strip()}")
    bill = json.loads(done.stdout)
    _tell_what_it_is_of(bill, wheel)
    text = json.dumps(bill, indent=2, sort_keys=True) + "\n"
    if (wrong := JsonStrictValidator(_VERSION).validate_str(text)) is not None:
        raise SystemExit(f"sbom: not valid: {wrong}")
    if "file:" in text:
        raise SystemExit("sbom: names a file of this machine")
    return text


def _tell_what_it_is_of(bill: dict[str, Any], wheel: Path) -> None:
    """Version and digest of the wheel: its version is not in pyproject.toml."""
    bill["metadata"]["component"] |= {
        "version": __version__,
        "purl": f"pkg:pypi/{_NAME}@{__version__}",
        "hashes": [{"alg": "SHA-256", "content": hashlib.sha256(wheel.read_bytes()).hexdigest()}],
    }
    bill["components"] = [part for part in bill["components"] if part["name"] != "pip"]
    bill["dependencies"] = [part for part in bill["dependencies"] if not part["ref"].startswith("pip==")]


def main() -> None:
    """Write the bills beside the wheel."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("dist", type=Path, nargs="?", default=ROOT / "dist", help="folder of the built wheel")
    dist = parser.parse_args().dist
    wheel = the_wheel(dist)
    for name, extras in BILLS.items():
        with tempfile.TemporaryDirectory() as folder:
            text = bill_of(new_venv(Path(folder) / name, wheel, *extras), wheel)
        path = dist / f"{_NAME.replace('-', '_')}-{__version__}-{name}.cdx.json"
        path.write_text(text)
        print(f"{path}: {len(json.loads(text)['components'])} packages")


if __name__ == "__main__":
    main()
