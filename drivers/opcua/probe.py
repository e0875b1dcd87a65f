"""Inspection of an OPC UA server, line by line: for the first hour with an unknown PLC."""

import statistics
from functools import partial

from drivers.opcua.client import OpcuaClient
from drivers.opcua.settings import Node, OpcuaSettings
from drivers.opcua.subscribe import Subscription
from drivers.opcua.trace import NodeTrace
from drivers.opcua.values import code_of, readable, status_name
from drivers.probe import TIMES, Line, looked_at, watched
from drivers.reconnect import REAL, Clock
from twin.errors import SourceError


def probe(settings: OpcuaSettings, clock: Clock = REAL) -> list[Line]:
    """Connect, read all configured values and report each; never raises SourceError."""
    link = OpcuaClient(settings, clock)
    try:
        connected = looked_at("connection", lambda: _connect(link, settings, clock))
        return [connected, *_inspect(link, settings, clock)] if connected.good else [connected]
    finally:
        link.close()


def _inspect(link: OpcuaClient, settings: OpcuaSettings, clock: Clock) -> list[Line]:
    lines: list[Line] = []
    for name, tag in settings.tags:
        if tag is not None:
            lines.append(looked_at(name, partial(_node_text, link, tag.node)))
            if lines[-1].lost:
                return lines  # nothing else would be answered, and each request would time out
    if settings.mode == "subscribe":
        subscription = Subscription(settings, clock)
        return [*lines, looked_at("subscription", lambda: _granted(link, subscription, settings))]
    trace = NodeTrace(settings, clock)
    return [
        *lines,
        looked_at("round trip", lambda: _round_trip(link, trace, settings, clock)),
        looked_at("trace", lambda: _ring(link, trace)),
        looked_at("scan rate", lambda: _rate(link, trace, clock)),
    ]


def _connect(link: OpcuaClient, settings: OpcuaSettings, clock: Clock) -> str:
    started = clock.now_ns()
    link.open()
    took_ms = (clock.now_ns() - started) * 1e-6
    return f"{settings.where}: connected in {took_ms:.0f} ms, security {settings.security.policy}"


def _node_text(link: OpcuaClient, node: Node) -> str:
    link.open()
    value = link.read((node,))[0]
    content = (
        f"{value.Value.VariantType.name} {value.Value.Value}" if readable(value) else "nothing"
    )
    return f"{node}: {content}, {status_name(code_of(value))}, of {value.SourceTimestamp} UTC"


def _granted(link: OpcuaClient, subscription: Subscription, settings: OpcuaSettings) -> str:
    """The granted sampling, in words; SourceError if it is too slow for a cycle."""
    link.open()
    granted = link.subscribe(subscription.nodes, subscription.queue)
    text = (
        f"samples every {granted.sampling_ms:g} ms, publishes every {granted.publishing_ms:g} ms, "
        f"keeps {granted.queue} values"
    )
    if granted.sampling_ms > 2 * settings.sampling_ms:
        raise SourceError(text, f"asked for was a sample every {settings.sampling_ms:g} ms")
    return text


def _round_trip(link: OpcuaClient, trace: NodeTrace, settings: OpcuaSettings, clock: Clock) -> str:
    """Median time to read the whole trace; SourceError if that is too slow."""
    link.open()
    took_ms = []
    for _ in range(TIMES):
        started = clock.now_ns()
        trace.ask(link)
        took_ms.append((clock.now_ns() - started) * 1e-6)
    median, worst = statistics.median(took_ms), max(took_ms)
    text = f"{median:.2f} ms in the median, {worst:.2f} ms at worst, of {TIMES} whole traces"
    if median > settings.interval_ms:
        raise SourceError(text, "too slow to read it every interval_ms")
    return text


def _ring(link: OpcuaClient, trace: NodeTrace) -> str:
    link.open()
    header = trace.start(link)
    return (
        f"{header.depth} records, one every {header.period_ns // 1000} µs; boot {header.boot}, "
        f"sequence {header.sequence}, PLC time {header.time_ns * 1e-9:.3f} s"
    )


def _rate(link: OpcuaClient, trace: NodeTrace, clock: Clock) -> str:
    """Scans per second by this machine's clock; SourceError if they do not fit the period."""
    link.open()
    return watched(lambda: trace.ask(link).header, clock)
