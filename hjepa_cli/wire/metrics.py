"""Counts of a server for Prometheus: one text page, made when it is asked for."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from hjepa_cli.errors import Unavailable, require

GAUGES = {
    "devices": "Devices with a session.",
    "embeddings_per_s": "Embeddings that came in the last second.",
    "datagrams_per_s": "Datagrams with forces that were sent in the last second.",
    "lost": "Embeddings that did not come, of the sessions of now.",
    "missed_deadlines": "Answers that came after their step, of the sessions of now.",
}


@contextlib.contextmanager
def exposed(
    host: str, port: int, latest: Callable[[], dict[str, Any]]
) -> Iterator[tuple[str, int]]:
    """Serve ``/metrics`` from a thread; ``latest`` returns a server's snapshot.

    Yields host and port.

    Raises:
        MissingInputError: prometheus-client is not installed.
        Unavailable: the port is taken.
    """
    require("prometheus_client", "--metrics needs prometheus-client", "runtime")
    from prometheus_client import CollectorRegistry, start_http_server
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    class Snapshots:
        def collect(self) -> Iterator[Any]:
            found = latest()
            for name, text in GAUGES.items():
                yield GaugeMetricFamily(f"hjepa_{name}", text, value=found.get(name, 0))
            waits = GaugeMetricFamily(
                "hjepa_answer_seconds",
                "Time from an embedding to its answer.",
                labels=["quantile"],
            )
            for name, value_ms in found.get("answer_ms", {}).items():
                waits.add_metric([f"0.{name[1:]}"], value_ms / 1e3)
            yield waits
            events = CounterMetricFamily(
                "hjepa_events", "What has come and gone, by name.", labels=["event"]
            )
            for name, count in found.get("counts", {}).items():
                events.add_metric([name], count)
            yield events

    registry = CollectorRegistry()
    registry.register(Snapshots())
    try:
        server, thread = start_http_server(port, host, registry)
    except OSError as error:
        raise Unavailable(
            f"--metrics {host}:{port}: {error.strerror}", hint="choose another port"
        ) from None
    try:
        yield host, server.server_port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
