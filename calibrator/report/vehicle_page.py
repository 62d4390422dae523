"""The page of one vehicle: light, to be printed, without a script."""

from collections.abc import Sequence

from markupsafe import Markup

from calibrator.estimator.vehicle_evidence import VehicleEvidence
from calibrator.estimator.vehicle_report import explanation_text
from calibrator.report.drawings import draw_evidence, draw_traces
from calibrator.report.templates import asset, template
from calibrator.report.traces import Traces
from calibrator.terminal.text import few
from ecu_node.parameters import VehicleParameters

__all__ = ["vehicle_page"]


def vehicle_page(
    parameters: VehicleParameters,
    *,
    evidence: VehicleEvidence | None,
    names: Sequence[str],
    ratios: int,
    traces: Sequence[Traces],
    missing: Sequence[str],
) -> str:
    """Write the page.

    Parameters
    ----------
    parameters : VehicleParameters
        Of the vehicle.
    evidence : VehicleEvidence or None
        What they were found from, if it was kept.
    names : sequence of str
        Of its rows.
    ratios : int
        How many of them are ratios.
    traces : sequence of Traces
        Currents to draw.
    missing : sequence of str
        What the page lacks, and what would give it.

    Returns
    -------
    str
        HTML.
    """
    residual = parameters.junction_residual
    held_back = [name for name, branch in parameters.branches.items() if branch.held_back]
    return template("vehicle.html").render(
        parameters=parameters,
        grows=held_back if residual.corrected_a > residual.measured_a else [],
        drawn=[{"title": each.title, "svg": draw_traces(each, expected_a=residual.expected_a)} for each in traces],
        evidence=None if evidence is None else draw_evidence(evidence, names, ratios=ratios),
        explanations=[(each.probability, explanation_text(each)) for each in parameters.explanations],
        missing=missing,
        drives=few(parameters.provenance.drives),
        style=Markup(asset("page.css")),  # noqa: S704 (of this package)
    )
