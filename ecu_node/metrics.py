"""Metrics for Prometheus; needs prometheus-client (``pip install 'hv-current-correction[metrics]'``)."""

from collections.abc import Iterator
from dataclasses import asdict

from ecu_node.corrector import Corrector
from ecu_node.errors import UserError

__all__ = ["serve_metrics"]


def serve_metrics(corrector: Corrector, port: int) -> None:
    """Answer Prometheus in a thread of its own, on this machine's address only.

    Parameters
    ----------
    corrector : Corrector
        Whose counters and state are told.
    port : int
        TCP port.

    Raises
    ------
    UserError
        If prometheus-client is not installed, or the port cannot be had.
    """
    try:
        from prometheus_client import CollectorRegistry, start_http_server  # noqa: PLC0415
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric  # noqa: PLC0415
    except ImportError:
        raise UserError(
            "--metrics-port needs prometheus-client; install it with pip install 'hv-current-correction[metrics]'"
        ) from None

    class Collector:
        def collect(self) -> Iterator[Metric]:
            for name, value in asdict(corrector.counters).items():
                yield CounterMetricFamily(f"ecu_node_{name}", f"{name.replace('_', ' ')} since the start", value=value)
            state, reason = corrector.told
            yield GaugeMetricFamily("ecu_node_state", "state, as in the status message", value=int(state))
            yield GaugeMetricFamily("ecu_node_reason", "reason, as in the status message", value=int(reason))
            yield GaugeMetricFamily("ecu_node_parameter_set", "number in force", value=corrector.parameter_set)
            sums = corrector.watch.sums
            if sums is not None:
                yield GaugeMetricFamily("ecu_node_sum_measured_amperes", "Kirchhoff sum", value=sums.measured_a)
                yield GaugeMetricFamily("ecu_node_sum_corrected_amperes", "Kirchhoff sum", value=sums.corrected_a)

    registry = CollectorRegistry()
    registry.register(Collector())
    try:
        start_http_server(port, addr="127.0.0.1", registry=registry)
    except (OSError, OverflowError) as error:
        raise UserError(f"port {port}: cannot answer there: {error}; give another --metrics-port") from None
