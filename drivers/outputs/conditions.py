"""Alarms of the twins as OPC UA conditions: events with their state, refresh, and acknowledgement.

This module knows no alarm objects: a change comes as plain data, and its source is asked to
acknowledge an alarm.
"""

import asyncio
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any

from asyncua import Server, ua
from asyncua.common.events import Event
from asyncua.common.instantiate_util import instantiate
from asyncua.server import monitored_item_service
from asyncua.server.address_space import AddressSpace

from drivers.opcua import security
from drivers.opcua.security import GuardedServer, Person
from twin.audit import Act
from twin.errors import TwinError
from twin.login import Authenticator
from twin.users import Role

Acknowledge = Callable[[str, str], None]  # takes the alarm's name, and the person's
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
SEVERITY = {"low": 300, "medium": 600, "high": 900}
_KEPT_EVENTS = 16  # events of a condition by which it can be acknowledged
_T, _S, _I = ua.VariantType, ua.StatusCodes, ua.ObjectIds


# --- the caller of a method ---------------------------------------------------------------------

CALLER: ContextVar[Person | None] = ContextVar("caller", default=None)


class Session(security.Session):
    """A session whose methods know their caller."""

    async def call(self, params: Any) -> Any:
        """Call methods; in them ``CALLER`` is the user of this session."""
        token = CALLER.set(self.user)
        try:
            return await super().call(params)
        finally:
            CALLER.reset(token)


class CallerAwareServer(GuardedServer):
    """The core of a server that refreshes conditions, and whose methods know their caller."""

    def __init__(self) -> None:
        super().__init__()
        self.bind_condition_methods = 100  # the severity of events around a refresh

    def create_session(self, name: Any, **options: Any) -> Session:
        """Begin a session."""
        return Session(self, self.aspace, self.subscription_service, name, **options)


# --- clients' filters of events -----------------------------------------------------------------


class SubtypesToo(monitored_item_service.WhereClauseEvaluator):  # type: ignore[misc]
    """Lets OfType match subtypes too: the library alone gives no alarms to a client that asks.

    The events around a refresh go to every client, whatever its filter.
    """

    def eval(self, event: Any) -> bool:
        """Whether the client's filter lets an event pass."""
        return event.EventType in _AROUND_REFRESH or bool(super().eval(event))

    def _eval_el(self, index: int, event: Any) -> Any:
        element = self.elements[index]
        if element.FilterOperator != ua.FilterOperator.OfType:
            return super()._eval_el(index, event)
        wanted_type = self._eval_op(element.FilterOperands[0], event)
        return wanted_type in _with_supertypes(self._aspace, event.EventType)


monitored_item_service.WhereClauseEvaluator = SubtypesToo


_AROUND_REFRESH = (ua.NodeId(_I.RefreshStartEventType), ua.NodeId(_I.RefreshEndEventType))


def _with_supertypes(space: AddressSpace, kind: ua.NodeId) -> list[ua.NodeId]:
    chain = []
    while (data := space.get(kind)) is not None:
        chain.append(kind)
        supertypes = [
            reference.NodeId
            for reference in data.references
            if reference.ReferenceTypeId == ua.NodeId(_I.HasSubtype) and not reference.IsForward
        ]
        kind = supertypes[0] if supertypes else ua.NodeId()
    return chain


# --- conditions ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Source:
    """The ejector that raises the alarms: its node, its name, and the nodes of its values."""

    node: ua.NodeId
    name: str
    values: Mapping[str, tuple[ua.NodeId, ua.NodeId]]  # by quantity: measured and expected
    acknowledge: Acknowledge | None = None


@dataclass
class Condition:
    """One alarm as an OPC UA condition."""

    name: str
    node: ua.NodeId
    source: Source
    acknowledged: bool = True
    severity: int = 0
    events: deque[bytes] = field(default_factory=lambda: deque(maxlen=_KEPT_EVENTS))


class Conditions:
    """The conditions of a server; ``authenticator`` knows the roles of users."""

    def __init__(self, server: Server, authenticator: Authenticator | None) -> None:
        self._server, self._authenticator = server, authenticator
        self._by_node: dict[ua.NodeId, Condition] = {}
        method = ua.NodeId(_I.AcknowledgeableConditionType_Acknowledge)
        server.link_method(server.get_node(method), self._acknowledge)

    async def tell(self, source: Source, change: Mapping[str, Any]) -> None:
        """Send an event with an alarm's state; a refresh repeats it while the alarm is retained."""
        name = str(change["alarm"])
        node = ua.NodeId(f"{source.name}.Alarms.{name}", source.node.NamespaceIndex)
        condition = self._by_node.get(node)
        if condition is None:
            condition = self._by_node[node] = Condition(name, node, source)
            await self._add(condition, _kind(source, change))
        event = _event(condition, change)
        condition.acknowledged = bool(change["acknowledged"])
        condition.severity = event.Severity
        condition.events.append(event.EventId)
        await self._write_fields(condition, event)
        await self._server.iserver.subscription_service.trigger_event(event)

    async def _add(self, condition: Condition, kind: int) -> None:
        """Create the nodes of an alarm below its ejector: those that its type requires."""
        index = condition.node.NamespaceIndex
        group = self._server.get_node(ua.NodeId(f"{condition.source.name}.Alarms", index))
        names = condition.node, ua.QualifiedName(condition.name, index)
        of_type = self._server.get_node(kind)
        node, *_ = await instantiate(group, of_type, *names, idx=index, instantiate_optional=False)
        self._server.link_method(await node.get_child("0:Acknowledge"), self._acknowledge)

    async def _write_fields(self, condition: Condition, event: Event) -> None:
        """Write the fields of an event into the variables of its alarm."""
        index, top = condition.node.NamespaceIndex, condition.node.Identifier
        for name, field_ in event.get_event_props_as_fields_dict().items():
            node = ua.NodeId(f"{top}.{name.replace('/', '.')}", index)
            if node in self._server.iserver.aspace:
                await self._server.write_attribute_value(node, ua.DataValue(field_))

    async def _acknowledge(
        self, node: ua.NodeId, event: ua.Variant, comment: ua.Variant
    ) -> ua.StatusCode:
        condition, person = self._by_node.get(node), CALLER.get()
        if condition is None:
            return ua.StatusCode(_S.BadNodeIdUnknown)
        if self._authenticator is None or person is None or not person.name:
            return ua.StatusCode(_S.BadUserAccessDenied)
        remark = _text(comment.Value)
        record = partial(self._authenticator.audit.record, who=person.name, address=person.address)
        details = {"unit": condition.source.name, "alarm": condition.name, "comment": remark}
        try:
            role = self._authenticator.users.role(person.name)
            if role is None or not role.covers(Role.ACKNOWLEDGE):
                await asyncio.to_thread(record, Act.DENIED, wanted="acknowledged", **details)
                return ua.StatusCode(_S.BadUserAccessDenied)
            if (refused := _refusal(condition, event.Value)) is not None:
                return refused
            actor = f"{person.name} ({remark})" if remark else person.name
            assert condition.source.acknowledge is not None
            # Both may block: on a database, and on a disk.
            await asyncio.to_thread(condition.source.acknowledge, condition.name, actor)
            await asyncio.to_thread(record, "acknowledged", **details)
        except TwinError:
            return ua.StatusCode(_S.BadResourceUnavailable)
        return ua.StatusCode(_S.Good)


def _refusal(condition: Condition, event: Any) -> ua.StatusCode | None:
    """The status that refuses to acknowledge the alarm by ``event``; None if it is possible."""
    if condition.source.acknowledge is None:
        return ua.StatusCode(_S.BadUserAccessDenied)
    if event not in condition.events:
        return ua.StatusCode(_S.BadEventIdUnknown)
    if condition.acknowledged:
        return ua.StatusCode(_S.BadConditionBranchAlreadyAcked)
    return None


def _text(comment: Any) -> str:
    return (getattr(comment, "Text", None) or "").strip()[:200]


def _event(condition: Condition, change: Mapping[str, Any]) -> Event:
    """The state of an alarm as an event of its condition."""
    event = Event(_I.Server)
    for name, (value, kind) in _fields(condition, change).items():
        event.add_property(name, value, kind)
    return event


def _kind(source: Source, change: Mapping[str, Any]) -> int:
    """The type of an alarm: a deviation if its quantity has a measured and an expected value."""
    compares = str(change["quantity"]) in source.values
    return int(_I.NonExclusiveDeviationAlarmType if compares else _I.OffNormalAlarmType)


def _fields(condition: Condition, change: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    active, acknowledged = bool(change["active"]), bool(change["acknowledged"])
    silenced = change["state"] in ("shelved", "suppressed", "out_of_service")
    inputs = condition.source.values.get(str(change["quantity"]))
    at = EPOCH + timedelta(microseconds=int(change["host_ns"]) // 1000)
    severity = SEVERITY[change["priority"]]
    fields: dict[str, tuple[Any, Any]] = {
        "EventId": (uuid.uuid4().bytes, _T.ByteString),
        "EventType": (ua.NodeId(_kind(condition.source, change)), _T.NodeId),
        "SourceNode": (condition.source.node, _T.NodeId),
        "SourceName": (condition.source.name, _T.String),
        "Time": (at, _T.DateTime),
        "ReceiveTime": (datetime.now(UTC), _T.DateTime),
        "Message": (ua.LocalizedText(str(change["text"])), _T.LocalizedText),
        "Severity": (severity, _T.UInt16),
        "NodeId": (condition.node, _T.NodeId),  # the ConditionId
        "ConditionClassId": (ua.NodeId(_I.MaintenanceConditionClassType), _T.NodeId),
        "ConditionClassName": (ua.LocalizedText("Maintenance"), _T.LocalizedText),
        "ConditionName": (condition.name, _T.String),
        "BranchId": (ua.NodeId(), _T.NodeId),
        "Retain": (active or not acknowledged, _T.Boolean),
        "Quality": (ua.StatusCode(_S.Good), _T.StatusCode),
        "LastSeverity": (condition.severity or severity, _T.UInt16),
        "Comment": (ua.LocalizedText(""), _T.LocalizedText),
        "ClientUserId": (str(change["who"]), _T.String),
        "SuppressedOrShelved": (silenced, _T.Boolean),
        **_state("EnabledState", True, "Enabled", "Disabled"),
        **_state("AckedState", acknowledged, "Acknowledged", "Unacknowledged"),
        **_state("ActiveState", active, "Active", "Inactive"),
        "InputNode": (inputs[0] if inputs else ua.NodeId(), _T.NodeId),
    }
    if inputs:
        fields["SetpointNode"] = inputs[1], _T.NodeId
    else:
        fields["NormalState"] = ua.NodeId(), _T.NodeId
    return fields


def _state(name: str, holds: bool, true_text: str, false_text: str) -> dict[str, tuple[Any, Any]]:
    """A two-valued state, as text and as the Boolean that programs read."""
    text = ua.LocalizedText(true_text if holds else false_text)
    return {name: (text, _T.LocalizedText), f"{name}/Id": (holds, _T.Boolean)}
