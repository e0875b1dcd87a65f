"""What the twin finds, served over OPC UA, so that a SCADA can read it; nobody can write.

Alarms are conditions, which some users may acknowledge (``drivers.results_alarms``).
The server runs in a thread of its own. The loops leave what is newest in their ``Results`` and go
on; here it is taken at an even pace. How it is laid out stands in docs/opcua.md.
"""

import asyncio
import logging
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from types import TracebackType
from typing import Any, Self

from asyncua import Node, Server, ua

from drivers.opcua_nodes import Names, Unit, add_quantity, add_state
from drivers.opcua_security import secure
from drivers.results_alarms import Acknowledge, Conditions, KnowingServer, Source
from drivers.results_settings import ResultsSettings
from drivers.results_state import MEANS, SIDES, Reading, Results, Standing, Status
from twin.errors import SourceError
from twin.signals import Phase

# It logs clients that hang up as errors; what stops the server is raised as well.
logging.getLogger("asyncua").setLevel(logging.CRITICAL + 1)

NAMESPACE = "urn:ejector-twin:results"
APPLICATION = "urn:ejector-twin:twin"
PATIENCE_S = 60.0  # for the library to build its address space on a busy machine
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
SPANS: dict[str, tuple[str, float, float]] = {  # unit: UNECE code, and a range for displays
    "mbar": ("MBR", 0.0, 2000.0),
    "bar": ("BAR", 0.0, 10.0),
    "ms": ("C26", 0.0, 60_000.0),
    "%": ("P1", 0.0, 100.0),
    "Wh": ("WHR", 0.0, 100.0),
    "Nl": ("", 0.0, 1000.0),
    "mbar/s": ("", 0.0, 1000.0),
}
_S = ua.StatusCodes
CODES = {
    Status.GOOD: _S.Good,
    Status.NONE_YET: _S.BadWaitingForInitialData,
    Status.LAST: _S.UncertainLastUsableValue,
    Status.BAD: _S.BadSensorFailure,
    Status.BEYOND: _S.BadOutOfRange,
    Status.MISSING: _S.BadNoDataAvailable,
    Status.ENDED: _S.BadOutOfService,
}
_T = ua.VariantType
PLAIN: dict[str, dict[str, ua.VariantType]] = {  # groups of values without a unit
    "Health": {"Since": _T.DateTime, "Text": _T.String, "Cause": _T.String, "Unit": _T.String}
    | {"Size": _T.Double},
    "Events": {"Times": _T.DateTime} | dict.fromkeys(("Kinds", "Severities", "Texts"), _T.String),
}


@dataclass
class Leaf:
    """A node: what the state calls it, its type, and what it shows."""

    name: str
    kind: ua.VariantType
    is_array: bool
    node: ua.NodeId
    shown: Reading | None = None


@dataclass
class Branch:
    """The nodes of one ejector."""

    results: Results
    source: Source
    leaves: list[Leaf] = field(default_factory=list)


class ResultsServer:
    """A server for all twins of a process; use it in a ``with``, and before the loops begin.

    ``figures`` are the key figures of a cycle and their units. SourceError where the address
    cannot be had, ConfigError where certificates or passwords cannot be used.
    """

    def __init__(self, settings: ResultsSettings, figures: Mapping[str, str]) -> None:
        self._settings = settings
        self._figures = figures
        self._branches: list[Branch] = []
        self._ready: Future[str] = Future()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="results")

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._ready.result(PATIENCE_S)
        except BaseException:
            self._thread.join()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._loop is not None
        with suppress(RuntimeError):  # it has ended by itself, and said why
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    @property
    def url(self) -> str:
        """Where it is reached."""
        return self._ready.result(PATIENCE_S)

    def sink(self, asset: str, kind: str, acknowledge: Acknowledge | None = None) -> Results:
        """Give a sink whose rows are served as ``asset``, of the type ``kind`` of ejectors.

        ``acknowledge`` is asked to acknowledge an alarm, in a thread; it may raise TwinError.
        """
        assert self._loop is not None
        results = Results(asset, tuple(self._figures))
        adding = self._add(results, kind, acknowledge)
        added = asyncio.run_coroutine_threadsafe(adding, self._loop)
        added.result(PATIENCE_S)
        return results

    # --- in its own thread ----------------------------------------------------------------------

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as error:
            if self._ready.done():
                raise
            self._ready.set_exception(error)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        server = self._server = await _prepared(self._settings)
        self._index = await server.register_namespace(NAMESPACE)
        names = ua.NodeId("EjectorTwin", self._index), ua.QualifiedName("EjectorTwin", self._index)
        self._root = await server.get_objects_node().add_object(*names)
        self._conditions = Conditions(server, self._settings.acknowledge)
        try:
            await server.start()
        except OSError as error:
            raise SourceError(
                f"results cannot be served on {self._settings.host}:{self._settings.port} (OPC UA):"
                f" {error.strerror or error}",
                "take another port under [results], or 0 for any free one",
            ) from error
        try:
            assert server.bserver is not None
            self._ready.set_result(f"opc.tcp://{self._settings.host}:{server.bserver.port}")
            await self._show_until_stopped()
        finally:
            await server.stop()

    async def _show_until_stopped(self) -> None:
        while not self._stop.is_set():
            for branch in self._branches:
                await self._show(branch)
            try:
                await asyncio.wait_for(self._stop.wait(), self._settings.interval_ms * 1e-3)
            except TimeoutError:
                continue

    async def _show(self, branch: Branch) -> None:
        """Write what has changed."""
        for change in branch.results.changes():
            await self._conditions.tell(branch.source, change)
        readings = branch.results.readings()
        for leaf in branch.leaves:
            reading = readings[leaf.name]
            if reading != leaf.shown:
                await self._server.write_attribute_value(leaf.node, _value(leaf, reading))
                leaf.shown = reading

    # --- the address space ----------------------------------------------------------------------

    async def _add(self, results: Results, kind: str, acknowledge: Acknowledge | None) -> None:
        """Lay out ``GROUPS`` below one object."""
        top = await self._root.add_object(*self._names(results.asset))
        source = Source(top.nodeid, results.asset, self._inputs(results.asset), acknowledge)
        branch = Branch(results, source)
        made = {name: await top.add_object(*self._names(results.asset, name)) for name in GROUPS}
        for name, text in (("Id", results.asset), ("Type", kind)):
            names = self._names(results.asset, "Identification", name)
            await made["Identification"].add_variable(*names, text, _T.String)
        for group, name, unit in self._quantities():
            branch.leaves.append(
                await self._quantity(made[group], results.asset, group, name, unit)
            )
        for group, name, states in STATES:
            names = self._names(results.asset, group, name)
            node = await add_state(self._server, made[group], names, states)
            branch.leaves.append(Leaf(name, _T.UInt32, False, node.nodeid))
        for group, kinds in PLAIN.items():
            for name, variant in kinds.items():
                names = self._names(results.asset, group, name)
                branch.leaves.append(await _plain(made[group], names, name, variant, group))
        names = self._names(results.asset, "Cycle", "Number")
        branch.leaves.append(await _plain(made["Cycle"], names, "cycle", _T.Int64, "Cycle"))
        await self._show(branch)
        self._branches.append(branch)

    def _inputs(self, asset: str) -> dict[str, tuple[ua.NodeId, ua.NodeId]]:
        """Where what alarms compare is: measured and expected, by quantity."""
        paths = {"pressure": (("Meas", "Pressure"), ("Model", "Expected"))}
        paths |= {
            name: (("Cycle", f"{name}_measured"), ("Cycle", f"{name}_expected"))
            for name in self._figures
        }
        return {
            quantity: (self._names(asset, *measured)[0], self._names(asset, *expected)[0])
            for quantity, (measured, expected) in paths.items()
        }

    def _names(self, *path: str) -> Names:
        """NodeId and browse name of what lies at ``path``."""
        return ua.NodeId(".".join(path), self._index), ua.QualifiedName(path[-1], self._index)

    def _quantities(self) -> Iterable[tuple[str, str, str]]:
        """Group, name and unit of every value that has one."""
        for group, name in (("Meas", "Pressure"), ("Meas", "Supply")):
            yield group, name, "mbar"
        for name in ("Expected", "Deviation"):
            yield "Model", name, "mbar"
        for name in MEANS:
            yield "Cycle", name, "mbar"
        for name, unit in self._figures.items():
            for side in SIDES:
                yield "Cycle", f"{name}_{side}", unit

    async def _quantity(self, parent: Node, asset: str, group: str, name: str, unit: str) -> Leaf:
        code, low, high = SPANS.get(unit, ("", 0.0, 1e6))
        if name == "Deviation" or name in MEANS:
            low = -high
        elif name == "Supply":
            high = 10_000.0
        node = await add_quantity(
            self._server,
            parent,
            self._names(asset, group, name),
            Unit(code, unit),
            (low, high),
            ua.NodeId(ua.ObjectIds.Double),
        )
        return Leaf(name, _T.Double, False, node.nodeid)


GROUPS = ("Identification", "Meas", "Model", "Cycle", "Health", "Events", "Alarms")
STATES: Sequence[tuple[str, str, list[str]]] = (
    ("Model", "Phase", [phase.name.lower().replace("_", "-") for phase in Phase]),
    ("Health", "State", [one.name.lower().replace("_", " ") for one in Standing]),
)


async def _prepared(settings: ResultsSettings) -> Server:
    server = Server(KnowingServer())
    await server.init()
    server.set_endpoint(f"opc.tcp://{settings.host}:{settings.port}/")
    server.set_server_name("ejector-twin")
    await server.set_application_uri(APPLICATION)
    await secure(server, settings, settings.passwords())
    return server


async def _plain(parent: Node, names: Names, name: str, kind: ua.VariantType, group: str) -> Leaf:
    """A variable without a unit; events are arrays of them."""
    leaf = Leaf(name, kind, group == "Events", names[0])
    empty = _variant(leaf, [] if leaf.is_array else _EMPTY[kind])
    await parent.add_variable(*names, empty, kind)
    return leaf


_EMPTY: dict[ua.VariantType, Any] = {_T.DateTime: 0, _T.String: "", _T.Double: 0.0, _T.Int64: -1}


def _value(leaf: Leaf, reading: Reading) -> ua.DataValue:
    return ua.DataValue(
        _variant(leaf, reading.value),
        ua.StatusCode(CODES[reading.status]),
        SourceTimestamp=_moment(reading.time_ns) if reading.time_ns else None,
        ServerTimestamp=datetime.now(UTC),
    )


def _variant(leaf: Leaf, value: Any) -> ua.Variant:
    """As OPC UA has it; moments come as ns since 1970."""
    if leaf.kind is _T.DateTime:
        value = [_moment(one) for one in value] if leaf.is_array else _moment(value)
    return ua.Variant(value, leaf.kind, is_array=leaf.is_array)


def _moment(ns: int) -> datetime:
    """A time to the microsecond that the library keeps."""
    return EPOCH + timedelta(microseconds=ns // 1000)


__all__ = ["ResultsServer", "ResultsSettings"]
