"""Alarms of the twins as OPC UA conditions: events with their state, refresh, and acknowledgement.

What is behind an alarm is not here: a change comes as plain data, and acknowledging one is asked of
whoever gave the change.
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

Acknowledge = Callable[[str, str], None]  # asks it: which alarm, and who does
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
SEVERITY = {"low": 300, "medium": 600, "high": 900}
_KNOWN = 16  # events of a condition by which it can be acknowledged
_T, _S, _I = ua.VariantType, ua.StatusCodes, ua.ObjectIds


# --- who calls ----------------------------------------------------------------------------------

CALLER: ContextVar[Person | None] = ContextVar("caller", default=None)


class Session(security.Session):
    """A session whose methods can know whose it is."""

    async def call(self, params: Any) -> Any:
        """Call methods; in them ``CALLER`` is the user of this session."""
        token = CALLER.set(self.user)
        try:
            return await super().call(params)
        finally:
            CALLER.reset(token)


class CallerAwareServer(GuardedServer):
    """What is inside of a server that refreshes conditions, and whose methods know who calls."""

    def __init__(self) -> None:
        super().__init__()
        self.bind_condition_methods = 100  # the severity of events around a refresh

    def create_session(self, name: Any, **options: Any) -> Session:
        """Begin a session."""
        return Session(self, self.aspace, self.subscription_service, name, **options)


# --- which events a client wants ----------------------------------------------------------------


class SubtypesToo(monitored_item_service.WhereClauseEvaluator):  # type: ignore[misc]
    """The library takes OfType for exactly that type: a client that asks for alarms got none.

    What is around a refresh goes to everybody, whatever they want.
    """

    def eval(self, event: Any) -> bool:
        """Whether a client wants an event."""
        return event.EventType in _AROUND_REFRESH or bool(super().eval(event))

    def _eval_el(self, index: int, event: Any) -> Any:
        element = self.elements[index]
        if element.FilterOperator != ua.FilterOperator.OfType:
            return super()._eval_el(index, event)
        wanted = self._eval_op(element.FilterOperands[0], event)
        return wanted in _with_supertypes(self._aspace, event.EventType)


monitored_item_service.WhereClauseEvaluator = SubtypesToo


_AROUND_REFRESH = (ua.NodeId(_I.RefreshStartEventType), ua.NodeId(_I.RefreshEndEventType))


def _with_supertypes(space: AddressSpace, kind: ua.NodeId) -> list[ua.NodeId]:
    found = []
    while (data := space.get(kind)) is not None:
        found.append(kind)
        above = [
            one.NodeId
            for one in data.references
            if one.ReferenceTypeId == ua.NodeId(_I.HasSubtype) and not one.IsForward
        ]
        kind = above[0] if above else ua.NodeId()
    return found


# --- conditions ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Source:
    """An ejector whose alarms these are: its node, its name, and where its values are."""

    node: ua.NodeId
    name: str
    values: Mapping[str, tuple[ua.NodeId, ua.NodeId]]  # by quantity: measured and expected
    acknowledge: Acknowledge | None = None


@dataclass
class Condition:
    """One alarm."""

    name: str
    node: ua.NodeId
    source: Source
    acknowledged: bool = True
    severity: int = 0
    events: deque[bytes] = field(default_factory=lambda: deque(maxlen=_KNOWN))


class Conditions:
    """The conditions of a server; ``authenticator`` knows the roles of users."""

    def __init__(self, server: Server, authenticator: Authenticator | None) -> None:
        self._server, self._authenticator = server, authenticator
        self._known: dict[ua.NodeId, Condition] = {}
        method = ua.NodeId(_I.AcknowledgeableConditionType_Acknowledge)
        server.link_method(server.get_node(method), self._acknowledge)

    async def tell(self, source: Source, change: Mapping[str, Any]) -> None:
        """Send an event with the state of an alarm, and keep it for a refresh while it concerns."""
        name = str(change["alarm"])
        node = ua.NodeId(f"{source.name}.Alarms.{name}", source.node.NamespaceIndex)
        condition = self._known.get(node)
        if condition is None:
            condition = self._known[node] = Condition(name, node, source)
            await self._add(condition, _kind(source, change))
        event = _event(condition, change)
        condition.acknowledged = bool(change["acknowledged"])
        condition.severity = event.Severity
        condition.events.append(event.EventId)
        await self._show(condition, event)
        await self._server.iserver.subscription_service.trigger_event(event)

    async def _add(self, condition: Condition, kind: int) -> None:
        """Lay out an alarm below its ejector: what its type demands."""
        index = condition.node.NamespaceIndex
        group = self._server.get_node(ua.NodeId(f"{condition.source.name}.Alarms", index))
        names = condition.node, ua.QualifiedName(condition.name, index)
        of_type = self._server.get_node(kind)
        node, *_ = await instantiate(group, of_type, *names, idx=index, instantiate_optional=False)
        self._server.link_method(await node.get_child("0:Acknowledge"), self._acknowledge)

    async def _show(self, condition: Condition, event: Event) -> None:
        """Write the fields of an event into the variables of its alarm."""
        index, top = condition.node.NamespaceIndex, condition.node.Identifier
        for name, field_ in event.get_event_props_as_fields_dict().items():
            node = ua.NodeId(f"{top}.{name.replace('/', '.')}", index)
            if node in self._server.iserver.aspace:
                await self._server.write_attribute_value(node, ua.DataValue(field_))

    async def _acknowledge(
        self, node: ua.NodeId, event: ua.Variant, comment: ua.Variant
    ) -> ua.StatusCode:
        condition, person = self._known.get(node), CALLER.get()
        if condition is None:
            return ua.StatusCode(_S.BadNodeIdUnknown)
        if self._authenticator is None or person is None or not person.name:
            return ua.StatusCode(_S.BadUserAccessDenied)
        said = _text(comment.Value)
        tell = partial(self._authenticator.audit.record, who=person.name, address=person.address)
        about = {"unit": condition.source.name, "alarm": condition.name, "comment": said}
        try:
            role = self._authenticator.users.role(person.name)
            if role is None or not role.covers(Role.ACKNOWLEDGE):
                await asyncio.to_thread(tell, Act.DENIED, wanted="acknowledged", **about)
                return ua.StatusCode(_S.BadUserAccessDenied)
            if (refused := _refused(condition, event.Value)) is not None:
                return refused
            who = f"{person.name} ({said})" if said else person.name
            assert condition.source.acknowledge is not None
            # Both may wait: for a database, and for a disk.
            await asyncio.to_thread(condition.source.acknowledge, condition.name, who)
            await asyncio.to_thread(tell, "acknowledged", **about)
        except TwinError:
            return ua.StatusCode(_S.BadResourceUnavailable)
        return ua.StatusCode(_S.Good)


def _refused(condition: Condition, event: Any) -> ua.StatusCode | None:
    """Why nobody can acknowledge an alarm by an event of it now."""
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
    """The type of an alarm: a deviation where there is something to compare."""
    compares = str(change["quantity"]) in source.values
    return int(_I.NonExclusiveDeviationAlarmType if compares else _I.OffNormalAlarmType)


def _fields(condition: Condition, change: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    active, acknowledged = bool(change["active"]), bool(change["acknowledged"])
    quiet = change["state"] in ("shelved", "suppressed", "out_of_service")
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
        "SuppressedOrShelved": (quiet, _T.Boolean),
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


def _state(name: str, is_so: bool, so: str, not_so: str) -> dict[str, tuple[Any, Any]]:
    """A state of two, in words and as what programs read."""
    words = ua.LocalizedText(so if is_so else not_so)
    return {name: (words, _T.LocalizedText), f"{name}/Id": (is_so, _T.Boolean)}
