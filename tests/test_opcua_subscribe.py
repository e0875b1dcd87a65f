"""Single nodes, published: rows at their source time, and whatever was lost is counted."""

import logging
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from asyncua import ua
from hypothesis import given
from hypothesis import strategies as st

from drivers.opcua.client import Subscribed
from drivers.opcua.settings import Node, OpcuaSettings
from drivers.opcua.subscribe import Subscription
from drivers.opcua.values import EPOCH
from drivers.reconnect import Clock, LostError
from twin.errors import SourceError
from twin.quality import Quality
from twin.signals import SAMPLE, Command, Samples

T = ua.VariantType
PRESSURE, SUCTION, BLOW_OFF = range(3)
START_US = 1_700_000_000_000_000
TAGS = {
    "pressure": {"node": "s=P", "unit": "mbar", "reference": "absolute", "range": [0, 1300]},
    "suction": {"node": "s=S"},
    "blow_off": {"node": "s=B", "bit": 3},
}
Value = tuple[int, float, float | bool | int, int]  # handle, ms, value, StatusCode


def change(handle: int, ms: float, value: Any, code: int = 0) -> ua.MonitoredItemNotification:
    kind = T.Null if value is None else (T.Float, T.Boolean, T.UInt16)[handle]
    return ua.MonitoredItemNotification(
        ClientHandle=handle,
        Value=ua.DataValue(
            ua.Variant(value, kind),
            ua.StatusCode(code),
            SourceTimestamp=EPOCH + timedelta(microseconds=START_US + round(ms * 1000)),
        ),
    )


def publication(changes: Sequence[Any], number: int) -> ua.PublishResult:
    parts = [ua.DataChangeNotification(MonitoredItems=list(changes))] if changes else []
    message = ua.NotificationMessage(SequenceNumber=number, NotificationData=parts)
    return ua.PublishResult(SubscriptionId=1, NotificationMessage=message)


class FakeLink:
    """Grants what it is told, and publishes what it is told."""

    def __init__(self, publications: Sequence[ua.PublishResult], granted: Subscribed) -> None:
        self.publications = list(publications)
        self.granted = granted
        self.asked_queue = 0
        self.held: list[ua.Variant] = [
            ua.Variant(900.0, T.Float),
            ua.Variant(False, T.Boolean),
            ua.Variant(0, T.UInt16),
        ]

    def read(self, nodes: tuple[Node, ...]) -> list[ua.DataValue]:
        return [ua.DataValue(variant) for variant in self.held]

    def subscribe(self, nodes: tuple[Node, ...], queue: int) -> Subscribed:
        self.asked_queue = queue
        return self.granted

    def published(self, silence_s: float) -> ua.PublishResult:
        if not self.publications:
            raise LostError("silent")
        return self.publications.pop(0)


def subscription(**changes: Any) -> Subscription:
    table = {
        "url": "opc.tcp://plc:4840",
        "namespace": "urn:plc",
        "mode": "subscribe",
        "interval_ms": 100,
        "sampling_ms": 10,
        "tags": TAGS,
    }
    return Subscription(OpcuaSettings.model_validate(table | changes), Clock())


def granted(
    sampling_ms: float = 10.0, publishing_ms: float = 100.0, queue: int = 200
) -> Subscribed:
    return Subscribed(publishing_ms, sampling_ms, queue, 1.0)


def rows(source: Subscription, link: FakeLink) -> Samples:
    """All that comes until the link is silent."""
    blocks = [np.empty(0, SAMPLE)]
    with pytest.raises(LostError):
        blocks.extend(source.samples(link))  # type: ignore[arg-type]
    return np.concatenate(blocks)


def published(*publications: Sequence[Any], **given: Any) -> Samples:
    numbered = [publication(part, number) for number, part in enumerate(publications, 1)]
    return rows(subscription(), FakeLink(numbered, granted(**given)))


def at_rest(first_ms: int = 0) -> list[Any]:
    return [change(SUCTION, first_ms, value=False), change(BLOW_OFF, first_ms, 0)]


def pressures(first_ms: int, count: int, every_ms: int = 10) -> list[Any]:
    return [change(PRESSURE, first_ms + every_ms * n, 900.0 - n) for n in range(count)]


def test_values_become_rows_at_their_source_time() -> None:
    samples = published(at_rest() + pressures(0, 10), pressures(100, 10))
    assert samples["sequence"].tolist() == list(range(20))
    assert samples["time_ns"][0] == START_US * 1000
    assert (np.diff(samples["time_ns"]) == 10_000_000).all()
    assert samples["pressure"][:3] == pytest.approx([90000, 89900, 89800])
    assert np.isnan(samples["supply"]).all()
    assert not samples["quality"].any()


def test_commands_are_those_that_held_then() -> None:
    switched = [change(SUCTION, 45, value=True), change(BLOW_OFF, 72, 0b1000)]
    samples = published(at_rest() + switched + pressures(0, 10), pressures(100, 2))
    suction = (samples["commands"] & Command.SUCTION) != 0
    blow_off = (samples["commands"] & Command.BLOW_OFF) != 0
    assert np.flatnonzero(suction).tolist() == [5, 6, 7, 8, 9, 10, 11]
    assert np.flatnonzero(blow_off).tolist() == [8, 9, 10, 11]


def test_bad_values_are_kept_and_marked() -> None:
    bad = change(PRESSURE, 20, 5.0, ua.StatusCodes.BadSensorFailure)
    stale = change(PRESSURE, 30, 880.0, ua.StatusCodes.UncertainLastUsableValue)
    nothing = change(PRESSURE, 40, None, ua.StatusCodes.BadNoCommunication)
    samples = published([*at_rest(), *pressures(0, 2), bad, stale, nothing])
    assert samples["quality"].tolist() == [0, 0, Quality.BAD, Quality.STALE, Quality.BAD]
    assert samples["pressure"][2] == pytest.approx(500)
    assert np.isnan(samples["pressure"][4])


def test_bad_commands_make_rows_bad() -> None:
    unknown = change(SUCTION, 25, None, ua.StatusCodes.BadNoCommunication)
    samples = published([*at_rest(), unknown, *pressures(0, 5)])
    assert samples["quality"].tolist() == [0, 0, 0, Quality.BAD, Quality.BAD]


def test_commands_that_never_came_are_not_taken_as_off() -> None:
    assert set(published(pressures(0, 3))["quality"]) == {Quality.BAD}
    nameless = ua.DataValue(SourceTimestamp=EPOCH + timedelta(microseconds=START_US))
    empty = ua.MonitoredItemNotification(ClientHandle=SUCTION, Value=nameless)
    samples = published([empty, at_rest()[1], *pressures(0, 3)])
    assert set(samples["quality"]) == {Quality.BAD}  # good, says the server, and sends no value


def test_missing_samples_are_missing_numbers_and_a_gap() -> None:
    samples = published(at_rest() + pressures(0, 3) + pressures(80, 2))
    assert samples["sequence"].tolist() == [0, 1, 2, 8, 9]
    assert samples["quality"].tolist() == [0, 0, 0, Quality.GAP, 0]


def test_an_overflown_queue_is_a_gap() -> None:
    lost = change(PRESSURE, 30, 890.0, 0x0480)
    samples = published([*at_rest(), *pressures(0, 3), lost])
    assert samples["quality"].tolist() == [0, 0, 0, Quality.GAP]


def test_a_lost_publication_is_a_gap() -> None:
    parts = [
        publication(at_rest() + pressures(0, 3), 4),
        publication([], 5),  # keep-alives carry the next number, and do not take it
        publication(pressures(30, 3), 5),
        publication(pressures(60, 3), 7),
    ]
    samples = rows(subscription(), FakeLink(parts, granted()))
    assert np.flatnonzero(samples["quality"] & Quality.GAP).tolist() == [6]


def test_numbers_of_publications_wrap_to_one() -> None:
    parts = [
        publication(at_rest() + pressures(0, 3), 0xFFFF_FFFF),
        publication(pressures(30, 3), 1),
    ]
    assert not rows(subscription(), FakeLink(parts, granted()))["quality"].any()


def test_time_that_runs_back_is_flagged() -> None:
    samples = published(at_rest() + pressures(0, 3), pressures(-50, 3))
    assert np.flatnonzero(samples["quality"] & Quality.CLOCK).tolist() == [3]
    assert (np.diff(samples["sequence"]) >= 1).all()


def test_what_has_been_is_forgotten() -> None:
    source = subscription()
    parts = [publication(at_rest(100 * n) + pressures(100 * n, 10), n) for n in range(1, 50)]
    assert len(rows(source, FakeLink(parts, granted()))) == 490
    assert max(len(column.times) for column in source._columns) == 1


def test_after_a_lost_connection_the_gap_shows() -> None:
    source = subscription()
    first = rows(source, FakeLink([publication(at_rest() + pressures(0, 3), 9)], granted()))
    again = [publication(at_rest(5000) + pressures(5000, 3), 1)]
    second = rows(source, FakeLink(again, granted()))
    assert second["sequence"][0] - first["sequence"][-1] == 498
    assert second["quality"].tolist() == [Quality.GAP, 0, 0]


def test_a_new_subscription_numbers_its_publications_anew() -> None:
    source = subscription()
    rows(source, FakeLink([publication(at_rest() + pressures(0, 3), 9)], granted()))
    again = rows(source, FakeLink([publication(at_rest(30) + pressures(30, 3), 1)], granted()))
    assert not again["quality"].any()


def test_revised_intervals_are_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    source = subscription()
    grant = granted(sampling_ms=50.0, publishing_ms=500.0, queue=5)
    link = FakeLink([publication(at_rest() + pressures(0, 4, 50), 1)], grant)
    with caplog.at_level(logging.WARNING):
        samples = rows(source, link)
        rows(source, FakeLink([], grant))
    assert caplog.messages == [
        "opc.tcp://plc:4840: the server samples every 50 ms, not 10, publishes every 500 ms, not "
        "100, keeps only 5 values, not 200: some will be lost"
    ]
    assert link.asked_queue == 200  # two seconds
    assert samples["sequence"].tolist() == [0, 1, 2, 3]  # by the interval that was granted
    assert not samples["quality"].any()


def test_as_asked_is_not_reported(caplog: pytest.LogCaptureFixture) -> None:
    published(at_rest())
    assert not caplog.messages


def test_a_node_of_another_type_is_told_before_it_is_subscribed() -> None:
    link = FakeLink([], granted())
    link.held[SUCTION] = ua.Variant("on", T.String)
    with pytest.raises(SourceError, match="s=S holds String; expected is a Boolean"):
        next(subscription().samples(link))  # type: ignore[arg-type]


def test_an_ended_subscription_is_lost() -> None:
    message = ua.NotificationMessage(NotificationData=[ua.StatusChangeNotification()])
    link = FakeLink([ua.PublishResult(1, NotificationMessage=message)], granted())
    with pytest.raises(LostError, match="ended the subscription"):
        next(subscription().samples(link))  # type: ignore[arg-type]


notifications = st.lists(
    st.tuples(
        st.integers(0, 2),
        st.integers(-1000, 1000),
        st.integers(0, 1),
        st.sampled_from([0, 0x0480, 0x40900000, 0x800A0000, 0xFFFF_FFFF]),
    ),
    max_size=20,
)


@given(parts=st.lists(st.tuples(notifications, st.integers(1, 9)), max_size=5))
def test_whatever_is_published_rows_are_numbered_upwards_and_nothing_is_invented(
    parts: list[tuple[list[Value], int]],
) -> None:
    cast = (float, bool, int)
    publications = [
        publication([change(h, ms, cast[h](v), code) for h, ms, v, code in part], number)
        for part, number in parts
    ]
    samples = rows(subscription(), FakeLink(publications, granted()))
    sent = [value for part, _ in parts for value in part if value[0] == PRESSURE]
    assert len(samples) == len(sent)
    assert (np.diff(samples["sequence"]) >= 1).all()
    marked = samples["quality"] & (Quality.BAD | Quality.STALE)
    bad = [code & 0xC000_0000 != 0 for *_, code in sent]
    assert (marked != 0)[bad].all()


@pytest.mark.parametrize("year", [1601, 9999])
def test_a_time_that_cannot_be_is_told_with_its_node(year: int) -> None:
    odd = change(0, 0.0, 900.0)
    odd.Value.SourceTimestamp = datetime(year, 12, 31, tzinfo=UTC)
    stream = subscription().samples(FakeLink([publication([odd], 1)], granted()))  # type: ignore[arg-type]
    with pytest.raises(SourceError, match=r"s=.* comes without a time that can be"):
        next(stream)
