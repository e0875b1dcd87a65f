"""The simulated PLC's OPC UA server from within: what is queued, and who may command."""

import asyncio
import tomllib
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import pytest
import rigs
from asyncua import Client, ua
from opcua_plc import tables
from pydantic import ValidationError

from drivers.opcua.values import lost_some
from drivers.plc.opcua import NAMESPACE, serving
from drivers.plc.opcua_server import Item
from drivers.plc.registers import Registers
from drivers.plc.scan import Task
from drivers.plc.settings import OpcuaServer, PlcSettings
from twin.signals import Command


def item(queue: int, *, always: bool) -> tuple[Item, list[ua.MonitoredItemNotification]]:
    queues: dict[int, list[Any]] = defaultdict(list)
    subscription = SimpleNamespace(_triggered_datachanges=queues)
    return Item(subscription, 5, 2, "Meas.Pressure", 1, queue, always, 0), queues[5]


def put(into: Item, *values: float) -> None:
    for value in values:
        into.put(ua.DataValue(ua.Variant(value, ua.VariantType.Float)))


def test_a_full_queue_loses_the_oldest_and_says_so() -> None:
    full, queue = item(3, always=True)
    put(full, 1.0, 2.0, 3.0)
    assert not any(lost_some(item.Value.StatusCode.value) for item in queue)
    put(full, 4.0, 5.0)
    assert [item.Value.Value.Value for item in queue] == [3.0, 4.0, 5.0]
    assert [lost_some(item.Value.StatusCode.value) for item in queue] == [True, False, False]
    assert {item.ClientHandle for item in queue} == {2}


def test_equal_values_are_queued_only_if_asked_for() -> None:
    changes, queue = item(9, always=False)
    put(changes, 1.0, 1.0, 2.0, 2.0, 1.0)
    assert [item.Value.Value.Value for item in queue] == [1.0, 2.0, 1.0]
    every, queue = item(9, always=True)
    put(every, 1.0, 1.0)
    assert len(queue) == 2


def test_policies_need_certificates() -> None:
    with pytest.raises(ValidationError, match="need certificates"):
        OpcuaServer(policies=("None", "Basic256Sha256"))


def test_clients_command_where_the_program_leaves_it_to_them() -> None:
    table = tables()["plc"] | {"program": {"commands": "coils"}}
    task = Task(PlcSettings.model_validate(table))

    async def command() -> None:
        memory = Registers(task, start_ns=0, boot=1)
        async with (
            serving([memory], OpcuaServer(port=0), lambda: task.advance_to(1)) as opcua,
            Client(opcua.url) as client,
        ):
            index = await client.get_namespace_index(NAMESPACE)
            node = client.get_node(f"ns={index};s=Cmd.BlowOff")
            await node.write_value(True)
            assert task.coils == Command.BLOW_OFF
            await node.write_value(False)
            assert task.coils == Command(0)
            with pytest.raises(ua.UaStatusCodeError, match="BadTypeMismatch"):
                await node.write_value("on")
            assert task.coils == Command(0)

    asyncio.run(command())


def test_the_shipped_rig_is_the_one_that_is_read_by_modbus() -> None:
    theirs = tomllib.loads(rigs.path_of("test_rig").read_text(encoding="utf-8"))
    ours = tables()
    assert ours["plc"].pop("opcua")
    assert ours.pop("driver")["kind"] == "opcua"
    assert ours == {key: value for key, value in theirs.items() if key != "driver"}
