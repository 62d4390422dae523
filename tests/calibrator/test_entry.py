import subprocess
import sys


def test_base_install_says_which_extra_the_calibrator_needs() -> None:
    code = "import sys; sys.modules['typer'] = None; from calibrator.__main__ import calibrator_program as run; run()"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert run.stderr == "calibrator: typer is not installed; pip install 'hv-current-correction[calibrator]'\n"
