"""An OPC UA server with a trace that lies: types, lengths, codes and times drawn by seed."""

import asyncio
import threading
from datetime import UTC, datetime
from typing import Any, Self

import numpy as np
from asyncua import Server, ua
from test_opcua_block import NODES, TornServer

from drivers.opcua.settings import Node

T = ua.VariantType
NAMESPACE = "urn:plc"
ODD = [
    ua.Variant(None, T.Null),
    ua.Variant("1", T.String),
    ua.Variant(True, T.Boolean),
    ua.Variant(-1, T.Int32),
    ua.Variant(2.5, T.Double),
    ua.Variant(2**64 - 1, T.UInt64),
    ua.Variant(2**63, T.UInt64),
    ua.Variant(datetime(9999, 12, 31, tzinfo=UTC), T.DateTime),
    ua.Variant([7] * 3, T.UInt16, None, True),
    ua.Variant([], T.UInt32, None, True),
    ua.Variant([2**31] * 1025, T.UInt32, None, True),
    ua.Variant(["x"], T.String, None, True),
]
CODES = ["BadOutOfService", "BadNodeIdUnknown", "BadNotReadable", "BadInternalError", "BadTimeout"]


class LyingNodes:
    """A server in a thread that reads a PLC as ``TornServer`` has it, and lies in ``share``."""

    def __init__(self, plc: TornServer, seed: int) -> None:
        self.plc, self.share = plc, 0.0
        self.lies: set[str] = set()
        self._random = np.random.default_rng(seed)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._ready.wait(60)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        server = Server()
        await server.init()
        server.set_endpoint("opc.tcp://127.0.0.1:0/")
        index = await server.register_namespace(NAMESPACE)
        for name in NODES:
            named = ua.NodeId(name, index), ua.QualifiedName(name, index)
            await server.nodes.objects.add_variable(*named, 0)
            server.iserver.aspace.set_attribute_value_callback(
                named[0], ua.AttributeIds.Value, self._value
            )
        async with server:
            assert server.bserver is not None
            self.url = f"opc.tcp://127.0.0.1:{server.bserver.port}"
            self._ready.set()
            await self._stop.wait()

    def _value(self, node: ua.NodeId, _attribute: Any) -> ua.DataValue:
        value = self.plc.value(Node(f"s={node.Identifier}"))
        if self._random.random() >= self.share:
            return value
        if self._random.random() < 0.3:
            code = CODES[int(self._random.integers(len(CODES)))]
            self.lies.add(code)
            return ua.DataValue(value.Value, ua.StatusCode(getattr(ua.StatusCodes, code)))
        odd = int(self._random.integers(len(ODD)))
        self.lies.add(str(odd))
        if odd == 3 and node.Identifier == "Supply":  # that could be one
            return value
        return ua.DataValue(ODD[odd])
