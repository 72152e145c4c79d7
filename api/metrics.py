"""Metrics in Prometheus' text format: requests by route, status and time to the first byte; sessions and jobs by
state."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: Upper ends (s) of the histogram's bins.
BINS_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0)
States = Callable[[], Mapping[str, int]]


class _ByState(Collector):
    """Counts that are looked up when they are asked for."""

    def __init__(self, counts: Mapping[str, States]) -> None:
        self._counts = counts

    def collect(self) -> Iterable[Metric]:
        """Return a gauge for each kind of thing, by state."""
        for what, states in self._counts.items():
            gauge = GaugeMetricFamily(f"calibench_{what}", f"{what.capitalize()} by state.", labels=["state"])
            for state, number in states().items():
                gauge.add_metric([state], number)
            yield gauge


class Metrics:
    """The metrics of one application."""

    def __init__(self, counts: Mapping[str, States]) -> None:
        self._registry = CollectorRegistry()
        self._registry.register(_ByState(counts))
        labels = ["method", "route", "status"]
        self._requests = Counter("calibench_requests", "Requests.", labels, registry=self._registry)
        self._first_byte = Histogram(
            "calibench_first_byte_seconds",
            "Time until the response begins.",
            ["method", "route"],
            buckets=BINS_S,
            registry=self._registry,
        )

    def count_response(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a response."""
        self._requests.labels(method, route, str(status)).inc()
        self._first_byte.labels(method, route).observe(seconds)

    def text(self) -> bytes:
        """Return all metrics, as Prometheus reads them."""
        return generate_latest(self._registry)


class CountedRequests:
    """Counts every request under its route's path, not its own: ids don't become labels."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app, self.metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and note when its response begins."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        began_s = time.perf_counter()

        async def note(message: Message) -> None:
            if message["type"] == "http.response.start":
                # A request that no route takes has no path of its own; a method that nobody uses is no label, either.
                route = getattr(scope.get("route"), "path", "none")
                method = scope["method"] if route != "none" else "any"
                self.metrics.count_response(method, route, message["status"], time.perf_counter() - began_s)
            await send(message)

        await self.app(scope, receive, note)
