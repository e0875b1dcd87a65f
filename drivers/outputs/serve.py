"""The process that serves the twins' results over OPC UA (``python -m drivers.outputs.serve FD``).

A SCADA can read them; nobody can write. Alarms are conditions, which some users may acknowledge
(``drivers.outputs.conditions``). Results come over a connection from ``drivers.outputs.results``,
so that no client of this server can disturb the loops. docs/opcua.md shows the address space.
"""

import asyncio
import itertools
import logging
import os
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from asyncua import Node, Server, ua
from asyncua.common.connection import TransportLimits
from asyncua.server import binary_server_asyncio

from drivers.opcua.bounds import refuse_endless_arrays
from drivers.opcua.security import Say, authenticator_of, secure
from drivers.outputs.conditions import CallerAwareServer, Conditions, Source
from drivers.outputs.nodes import Names, Unit, add_quantity, add_state
from drivers.outputs.settings import ResultsSettings
from drivers.outputs.state import MEANS, SIDES, Reading, Standing, Status
from twin.errors import SourceError, TwinError
from twin.login import Authenticator
from twin.signals import Phase

# The library logs clients that hang up as errors; what stops the server is raised as well.
logging.getLogger("asyncua").setLevel(logging.CRITICAL + 1)

NAMESPACE = "urn:ejector-twin:results"
APPLICATION = "urn:ejector-twin:twin"
ANSWER_S = 60.0  # to acknowledge an alarm: it may wait for a database
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
    """A variable: its name among the readings, its type, and its node."""

    name: str
    kind: ua.VariantType
    is_array: bool
    node: ua.NodeId


@dataclass
class Branch:
    """The nodes of one ejector."""

    source: Source
    leaves: dict[str, Leaf] = field(default_factory=dict)


class Asking:
    """Asks the process that holds the alarms to acknowledge them, and waits for its answer."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe, self._sending = pipe, threading.Lock()
        self._waiting: dict[int, Future[str]] = {}
        self._numbers = itertools.count(os.getpid() << 32)  # unique to this process

    def send(self, message: tuple[Any, ...]) -> None:
        """Send a message; those of other threads do not mix with it."""
        with self._sending:
            self._pipe.send(message)

    def complain(self, text: str) -> None:
        """Have a trouble logged by the process of the loops, where a person reads it."""
        self.send(("complaint", text))

    def ask(self, asset: str, alarm: str, user: str) -> None:
        """Have an alarm acknowledged; SourceError if that is refused, or no answer comes."""
        number, answer = next(self._numbers), Future[str]()
        self._waiting[number] = answer
        self.send(("acknowledge", number, asset, alarm, user))
        try:
            refused = answer.result(ANSWER_S)
        except FutureTimeout as error:
            raise SourceError(f"{alarm} could not be acknowledged: no answer") from error
        finally:
            del self._waiting[number]
        if refused:
            raise SourceError(refused)

    def answered(self, number: int, refused: str) -> None:
        """Pass on an answer; ``refused`` is empty if the alarm was acknowledged."""
        if number in self._waiting:
            self._waiting[number].set_result(refused)


class Serving:
    """The server, and the nodes of all ejectors."""

    def __init__(
        self, settings: ResultsSettings, figures: Mapping[str, str], asking: Asking
    ) -> None:
        self._settings, self._figures, self._asking = settings, figures, asking
        self._branches: dict[str, Branch] = {}

    async def run(self, messages: "asyncio.Queue[tuple[Any, ...] | None]") -> None:
        """Serve until there are no more messages; SourceError if the address is not available."""
        authenticator = authenticator_of(self._settings.users, self._asking.complain)
        server = await _prepared(self._settings, authenticator, self._asking.complain)
        self._server = server
        self._index = await server.register_namespace(NAMESPACE)
        names = ua.NodeId("EjectorTwin", self._index), ua.QualifiedName("EjectorTwin", self._index)
        self._root = await server.get_objects_node().add_object(*names)
        self._conditions = Conditions(server, authenticator)
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
            self._asking.send(("ready", server.bserver.port))
            while (message := await messages.get()) is not None:
                await self._take(*message)
                self._asking.send(("done",))
        finally:
            await server.stop()

    async def _take(self, kind: str, *args: Any) -> None:
        if kind == "add":
            await self._add(*args)
            return
        (updates,) = args
        for asset, readings, changes in updates:
            await self._show(self._branches[asset], readings, changes)

    async def _show(
        self,
        branch: Branch,
        readings: Mapping[str, Reading],
        changes: Sequence[Mapping[str, Any]],
    ) -> None:
        """Write the changes."""
        for change in changes:
            await self._conditions.tell(branch.source, change)
        for name, reading in readings.items():
            leaf = branch.leaves[name]
            await self._server.write_attribute_value(leaf.node, _value(leaf, reading))

    # --- the address space ----------------------------------------------------------------------

    async def _add(self, asset: str, kind: str, may_acknowledge: bool) -> None:
        """Create the nodes of an ejector: ``GROUPS`` below one object."""
        top = await self._root.add_object(*self._names(asset))
        acknowledge = partial(self._asking.ask, asset) if may_acknowledge else None
        branch = Branch(Source(top.nodeid, asset, self._inputs(asset), acknowledge))
        leaves: list[Leaf] = []
        groups = {name: await top.add_object(*self._names(asset, name)) for name in GROUPS}
        for name, text in (("Id", asset), ("Type", kind)):
            names = self._names(asset, "Identification", name)
            await groups["Identification"].add_variable(*names, text, _T.String)
        for group, name, unit in self._quantities():
            leaves.append(await self._quantity(groups[group], asset, group, name, unit))
        for group, name, states in STATES:
            names = self._names(asset, group, name)
            node = await add_state(self._server, groups[group], names, states)
            leaves.append(Leaf(name, _T.UInt32, False, node.nodeid))
        for group, kinds in PLAIN.items():
            for name, variant in kinds.items():
                names = self._names(asset, group, name)
                leaves.append(await _plain(groups[group], names, name, variant, group))
        names = self._names(asset, "Cycle", "Number")
        leaves.append(await _plain(groups["Cycle"], names, "cycle", _T.Int64, "Cycle"))
        branch.leaves |= {leaf.name: leaf for leaf in leaves}
        self._branches[asset] = branch

    def _inputs(self, asset: str) -> dict[str, tuple[ua.NodeId, ua.NodeId]]:
        """Nodes of the values that alarms compare: measured and expected, by quantity."""
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
        """NodeId and browse name of the node at ``path``."""
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
    ("Health", "State", [standing.name.lower().replace("_", " ") for standing in Standing]),
)


# --- limits for clients -------------------------------------------------------------------------

MOST_CONNECTIONS = 32
MOST_CHUNK = 65_535  # bytes; the library keeps at most one incomplete chunk
MOST_MESSAGE = 1 << 20  # bytes; the longest sensible request has some thousands
SESSION_WITHIN_S = 10.0  # of connecting
LONGEST_SESSION_MS = 60_000.0  # without a request
MOST_REQUESTS = 100  # that wait, of one connection


class BoundedProtocol(binary_server_asyncio.OPCUAProtocol):  # type: ignore[misc]
    """A connection that hangs up on a chunk beyond the limit.

    The library would wait for the whole chunk, whatever length its head announces, and keep it.
    """

    def data_received(self, data: bytes) -> None:
        """Take bytes as they come."""
        super().data_received(data)
        if len(self._buffer) > self.limits.max_recv_buffer and self.transport is not None:
            self.transport.abort()


binary_server_asyncio.OPCUAProtocol = BoundedProtocol


def _bounded(server: Server) -> None:
    """Limit what clients may use of the server."""
    server.limits = TransportLimits(
        max_recv_buffer=MOST_CHUNK,
        max_send_buffer=MOST_CHUNK,
        max_chunk_count=MOST_MESSAGE // MOST_CHUNK + 1,
        max_message_size=MOST_MESSAGE,
    )
    inside = server.iserver
    inside.max_connections = MOST_CONNECTIONS
    inside.max_pending_activation_seconds = SESSION_WITHIN_S
    inside.max_session_timeout_ms = LONGEST_SESSION_MS
    inside.max_pending_messages_per_connection = MOST_REQUESTS


async def _prepared(
    settings: ResultsSettings, authenticator: Authenticator | None, say: Say
) -> Server:
    server = Server(CallerAwareServer())
    await server.init()
    _bounded(server)
    server.set_endpoint(f"opc.tcp://{settings.host}:{settings.port}/")
    server.set_server_name("ejector-twin")
    await server.set_application_uri(APPLICATION)
    await secure(server, settings, authenticator, say)
    return server


async def _plain(parent: Node, names: Names, name: str, kind: ua.VariantType, group: str) -> Leaf:
    """Add a variable without a unit; those of events are arrays."""
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
    """The value for OPC UA; times come as ns since 1970."""
    if leaf.kind is _T.DateTime:
        value = [_moment(stamp) for stamp in value] if leaf.is_array else _moment(value)
    return ua.Variant(value, leaf.kind, is_array=leaf.is_array)


def _moment(ns: int) -> datetime:
    """A time, to the microsecond: the library keeps no more."""
    return EPOCH + timedelta(microseconds=ns // 1000)


# --- the process --------------------------------------------------------------------------------


async def serve(pipe: Connection) -> None:
    """Serve what comes over ``pipe`` until it is closed; a failure is reported over it."""
    (settings, figures), asking = pipe.recv(), Asking(pipe)
    messages: asyncio.Queue[tuple[Any, ...] | None] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def receive() -> None:
        with suppress(EOFError, OSError):
            while True:
                message = pipe.recv()
                if message[0] == "acknowledged":
                    asking.answered(*message[1:])
                else:  # one at a time: the next one comes when it is done
                    loop.call_soon_threadsafe(messages.put_nowait, message)
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(messages.put_nowait, None)

    threading.Thread(target=receive, name="messages", daemon=True).start()
    try:
        await Serving(settings, figures, asking).run(messages)
    except TwinError as error:
        asking.send(("failed", error))


def main() -> None:
    """Run as a process; the number of the connection is the argument."""
    refuse_endless_arrays()
    with suppress(BrokenPipeError), Connection(int(sys.argv[1])) as pipe:
        asyncio.run(serve(pipe))


if __name__ == "__main__":
    main()
