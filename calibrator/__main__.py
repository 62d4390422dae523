"""``python -m calibrator`` and the console command; the base install has the node alone."""

import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line, or say which extra it needs."""
    try:
        from calibrator.cli import main as run  # noqa: PLC0415
    except ModuleNotFoundError as error:
        print(
            f"calibrator: {error.name} is not installed; pip install 'hv-current-correction[calibrator]'",
            file=sys.stderr,
        )
        raise SystemExit(1) from None
    run()


if __name__ == "__main__":
    main()
