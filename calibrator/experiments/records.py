"""A folder of results: NAME.json, NAME.md and NAME.png per experiment, and the index page beside the folder."""

from collections.abc import Sequence
from pathlib import Path

from calibrator.experiments.picture import write_picture
from calibrator.experiments.result import ExperimentResult, decode_result
from calibrator.experiments.table import caption, headline, markdown_table, repetitions_text, result_markdown
from ecu_node.user_files import write_atomically

__all__ = ["index_path", "read_results", "write_result"]


def write_result(folder: Path, result: ExperimentResult, order: Sequence[str]) -> None:
    """Write one result, and the index of all results of the folder.

    Parameters
    ----------
    folder : Path
        Made if missing.
    result : ExperimentResult
        Of one experiment.
    order : sequence of str
        Names of the experiments in the order of the index.

    Raises
    ------
    FleetError
        If another record of the folder is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{result.name}.json", result.to_json())
    write_atomically(folder / f"{result.name}.md", result_markdown(result, picture=f"{result.name}.png").encode())
    write_picture(result, folder / f"{result.name}.png")
    write_atomically(index_path(folder), _index(folder, read_results(folder, order)).encode())


def read_results(folder: Path, order: Sequence[str]) -> list[ExperimentResult]:
    """Read the records of a folder in the given order; those that are not there are left out."""
    paths = [folder / f"{name}.json" for name in order]
    return [decode_result(path.read_bytes(), str(path)) for path in paths if path.is_file()]


def index_path(folder: Path) -> Path:
    """Page beside the folder: ``docs/results.md`` for ``docs/results``."""
    return folder.parent / f"{folder.name}.md"


def _index(folder: Path, results: Sequence[ExperimentResult]) -> str:
    lines = ["# Results of the experiments", "", f"Written by `calibrator experiment`. {caption(results)}", ""]
    for result in results:
        settings = result.settings
        lines += [
            f"## [{result.title}]({folder.name}/{result.name}.md)",
            "",
            f"`calibrator experiment {result.name}`: {repetitions_text(settings)}, seed {settings['seed']}, "
            f"drive {settings['drive']}{f'; {result.made}' if result.made else ''}.",
            "",
            *markdown_table(*headline(result)),
            "",
        ]
    return "\n".join(lines)
