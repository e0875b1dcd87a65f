"""Behaviour of real OPC UA servers that the library lacks: sampling, revising, delays, hang-ups.

The library reports every write and accepts every interval. Here each monitored item is sampled from
the scans at its revised interval, into a queue that can overflow.
"""

import asyncio
import time
from collections.abc import Callable, Set
from dataclasses import dataclass
from typing import Any

from asyncua import Server, ua
from asyncua.server.internal_subscription import InternalSubscription
from asyncua.server.subscription_service import SubscriptionService

from drivers.plc.settings import OpcuaServer

OVERFLOW = 0x480  # info type DataValue, overflow: set on the first value after lost ones
Sample = Callable[[str, int], ua.DataValue]  # value of a node at a scan


@dataclass
class Item:
    """A monitored item that is sampled from the scans."""

    subscription: InternalSubscription
    number: int  # of the item
    handle: int  # the client's
    name: str
    every: int  # scans
    queue: int  # values
    always: bool  # also values that have not changed
    after: int  # newest scan at its creation, which was queued then
    last: ua.Variant | None = None

    def put(self, value: ua.DataValue) -> None:
        """Queue a value for the next publishing, unless it has not changed."""
        if not self.always and value.Value == self.last:
            return
        self.last = value.Value
        queue = self.subscription._triggered_datachanges.setdefault(self.number, [])
        queue.append(ua.MonitoredItemNotification(ClientHandle=self.handle, Value=value))
        if len(queue) > self.queue:
            del queue[0]
            queue[0] = _overflown(queue[0])


def _overflown(notification: ua.MonitoredItemNotification) -> ua.MonitoredItemNotification:
    value = notification.Value
    status = value.StatusCode.value if value.StatusCode else 0
    marked = ua.DataValue(
        Value=value.Value,
        StatusCode=ua.StatusCode(status | OVERFLOW),
        SourceTimestamp=value.SourceTimestamp,
    )
    return ua.MonitoredItemNotification(ClientHandle=notification.ClientHandle, Value=marked)


class Behaviour:
    """Replaces the library's subscriptions of one server."""

    def __init__(
        self,
        server: Server,
        settings: OpcuaServer,
        value: Sample,
        names: Set[str],
        newest: Callable[[], int],
    ) -> None:
        self._server = server
        self._settings = settings
        self._value = value
        self._newest = newest
        self._sampled = -1  # newest scan that subscribers have seen
        self._dropped = time.monotonic()
        self.subscriptions = Subscriptions(server, settings, names, newest)
        server.iserver.subscription_service = self.subscriptions
        server.iserver.isession.subscription_service = self.subscriptions

    def sample(self) -> None:
        """Sample all items up to the newest scan, and hang up on all clients when it is due."""
        newest = self._newest()
        for item in self.subscriptions.living():
            begin = max(self._sampled, item.after) + 1
            first = -(-begin // item.every) * item.every
            for sequence in range(first, newest + 1, item.every):
                item.put(self._value(item.name, sequence))
        self._sampled = newest
        every = self._settings.drop_every_s
        if every and time.monotonic() - self._dropped > every:
            self._dropped = time.monotonic()
            for transport in list(self._server.iserver.asyncio_transports):
                transport.abort()


class Subscriptions(SubscriptionService):  # type: ignore[misc]
    """The library's subscriptions, with revised intervals and sampled items."""

    def __init__(
        self, server: Server, settings: OpcuaServer, names: Set[str], newest: Callable[[], int]
    ) -> None:
        super().__init__(server.iserver.aspace, server.iserver)
        self._newest = newest
        self._settings = settings
        self._names = names
        self._items: list[Item] = []

    def living(self) -> list[Item]:
        """Items of subscriptions that still exist; other items are removed."""
        self._items = [
            item
            for item in self._items
            if item.subscription.data.SubscriptionId in self.subscriptions
        ]
        return self._items

    async def create_subscription(
        self,
        params: ua.CreateSubscriptionParameters,
        callback: Callable[..., Any],
        *args: Any,
        **kwargs: Any,
    ) -> ua.CreateSubscriptionResult:
        """Create it with a publishing interval not below the configured minimum."""
        requested_ms = params.RequestedPublishingInterval
        params.RequestedPublishingInterval = max(requested_ms, self._settings.min_publishing_ms)
        return await super().create_subscription(params, self._delayed(callback), *args, **kwargs)

    def _delayed(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        async def publish(*results: Any) -> None:
            await asyncio.sleep(self._settings.late_publishing_ms * 1e-3)
            await callback(*results)

        return publish if self._settings.late_publishing_ms else callback

    async def create_monitored_items(
        self, params: ua.CreateMonitoredItemsParameters
    ) -> list[ua.MonitoredItemCreateResult]:
        """Create them, with revised sampling intervals and queues."""
        results: list[ua.MonitoredItemCreateResult] = await super().create_monitored_items(params)
        for request, result in zip(params.ItemsToCreate, results, strict=True):
            name = request.ItemToMonitor.NodeId.Identifier
            if result.StatusCode.is_good() and name in self._names:
                self._sample_item(self.subscriptions[params.SubscriptionId], name, request, result)
        return results

    def _sample_item(
        self,
        subscription: InternalSubscription,
        name: str,
        request: ua.MonitoredItemCreateRequest,
        result: ua.MonitoredItemCreateResult,
    ) -> None:
        requested = request.RequestedParameters
        interval = requested.SamplingInterval
        if interval < 0:  # as often as is published
            interval = subscription.data.RevisedPublishingInterval
        every = max(round(interval), self._settings.min_sampling_ms)
        queue = max(1, min(requested.QueueSize, self._settings.max_queue))
        result.RevisedSamplingInterval = float(every)
        result.RevisedQueueSize = queue
        trigger = requested.Filter.Trigger if requested.Filter else ua.DataChangeTrigger.StatusValue
        always = trigger == ua.DataChangeTrigger.StatusValueTimestamp
        number, handle = result.MonitoredItemId, requested.ClientHandle
        self._items.append(
            Item(subscription, number, handle, name, every, queue, always, self._newest())
        )
