"""Inspection of a Modbus PLC, line by line: for the first hour with an unknown PLC."""

import statistics
from functools import partial

import numpy as np

from drivers.modbus.client import ModbusClient
from drivers.modbus.plan import plan
from drivers.modbus.ring import RECORDS_AT_ONCE, Trace
from drivers.modbus.settings import ModbusSettings
from drivers.probe import TIMES, Line, looked_at, watched
from drivers.reconnect import REAL, Clock
from drivers.tags import Address, Pressure, Tag, WordOrder, Words, numbers
from twin.errors import SourceError
from twin.signals import BAR, MBAR

TEST_REGISTERS = Address("holding", 0)
ORDERS: tuple[WordOrder, ...] = ("big", "little")
# Plausible absolute pressures: no ejector evacuates to 2 mbar, and no network of compressed air
# has more than PN 16. Numbers beyond are of another type, or have their words swapped.
POSSIBLE = 2.0 * MBAR, 17.0 * BAR


def probe(settings: ModbusSettings, clock: Clock = REAL) -> list[Line]:
    """Connect, read all configured values and report each; never raises SourceError."""
    link = ModbusClient(settings)
    try:
        connected = looked_at("connection", lambda: _connect(link, settings, clock))
        return [connected, *_inspect(link, settings, clock)] if connected.good else [connected]
    finally:
        link.close()


def _inspect(link: ModbusClient, settings: ModbusSettings, clock: Clock) -> list[Line]:
    lines = [looked_at("round trip", lambda: _round_trip(link, settings, clock))]
    if lines[0].lost:
        return lines  # nothing else would be answered, and each request would time out
    for name, tag in settings.tags:
        if tag is not None:
            lines.append(looked_at(name, partial(_tag_text, link, tag, settings)))
    lines.append(_word_order(link, settings))
    if settings.mode == "block":
        trace = Trace(settings, clock)
        lines.append(looked_at("trace header", lambda: _header(link, trace)))
        lines.append(looked_at("trace records", lambda: _records(link, trace)))
        lines.append(looked_at("scan rate", lambda: _rate(link, trace, clock)))
    return lines


def _connect(link: ModbusClient, settings: ModbusSettings, clock: Clock) -> str:
    started = clock.now_ns()
    link.open()
    return f"{settings.where}: connected in {(clock.now_ns() - started) * 1e-6:.1f} ms"


def _round_trip(link: ModbusClient, settings: ModbusSettings, clock: Clock) -> str:
    """Median time of one request; SourceError if that is too slow for the mode."""
    tags = [tag for _, tag in settings.tags if tag is not None]
    requests = 1 if settings.mode == "block" else len(plan(tags))
    took_ms = []
    for _ in range(TIMES):
        started = clock.now_ns()
        link.read(tags[0].address, tags[0].size)
        took_ms.append((clock.now_ns() - started) * 1e-6)
    median, worst = statistics.median(took_ms), max(took_ms)
    text = f"{median:.2f} ms in the median, {worst:.2f} ms at worst, of {TIMES} requests"
    if settings.mode == "block" and median > 0.8 * RECORDS_AT_ONCE:
        raise SourceError(text, "too slow to follow 1 ms scans with 31 records per request")
    if settings.mode == "poll" and median * requests > 1.0:
        rate = 1e3 / (median * requests)
        raise SourceError(text, f"polling will reach {rate:.0f} samples a second instead of 1000")
    return text


def _tag_text(link: ModbusClient, tag: Tag, settings: ModbusSettings) -> str:
    link.open()
    words = link.read(tag.address, tag.size).reshape(1, tag.size)
    hexadecimal = " ".join(f"0x{word:04X}" for word in words[0])
    orders = ORDERS if tag.size > 1 else (settings.word_order,)
    values = [_value(tag, words, order, settings) for order in orders]
    if len(orders) > 1:
        values = [f"{order} {value}" for order, value in zip(orders, values, strict=True)]
        values.append(f"configured {settings.word_order}")
    text = f"{tag.address}: {hexadecimal} = {', '.join(values)}"
    if isinstance(tag, Pressure) and not _is_possible(tag, words, settings.word_order, settings):
        plausible_orders = [order for order in orders if _is_possible(tag, words, order, settings)]
        check = "check its address, type, scale, unit and range under [driver.tags]"
        raise SourceError(
            f"{text}: this pressure cannot be",
            f'word_order = "{plausible_orders[0]}" in [driver] gives one that can be; or {check}'
            if plausible_orders
            else check,
        )
    return text


def _is_possible(tag: Pressure, words: Words, order: WordOrder, settings: ModbusSettings) -> bool:
    """Whether an ejector can have this pressure, and it lies within the tag's range."""
    pascal, quality = tag.decode(words, order, settings.ambient_mbar * MBAR)
    return not quality[0] and POSSIBLE[0] <= float(pascal[0]) <= POSSIBLE[1]


def _value(tag: Tag, words: Words, order: WordOrder, settings: ModbusSettings) -> str:
    raw = tag.raw(words, order)[0]
    if not isinstance(tag, Pressure):
        return f"{raw}"
    pascal, quality = tag.decode(words, order, settings.ambient_mbar * MBAR)
    flags = " flagged" if quality[0] else ""
    return f"{raw:.6g} → {pascal[0] / MBAR:.5g} mbar absolute{flags}"


def word_order_of(words: Words) -> WordOrder | None:
    """The word order that the test registers (6 words) show; None if they are no such registers."""
    if words[0] != 0x1234 or words[1] != 0x10000 - 12345:
        return None
    for order in ORDERS:
        integer, real = numbers(words[2:4], ">u4", order), numbers(words[4:6], ">f4", order)
        if integer == 0x12345678 and real == np.float32(123.456):
            return order
    return None


def _word_order(link: ModbusClient, settings: ModbusSettings) -> Line:
    """Test registers are optional: a PLC without them is not at fault."""
    try:
        link.open()
        order = word_order_of(link.read(TEST_REGISTERS, 6))
    except SourceError as error:
        return Line("word order", f"no test registers ({error})")
    if order is None:
        return Line("word order", f"no test registers at {TEST_REGISTERS}: compare both orders")
    text = f"{order}, by the test registers at {TEST_REGISTERS}"
    if order == settings.word_order:
        return Line("word order", text)
    return Line("word order", text, False, f'set word_order = "{order}" in [driver]')


def _header(link: ModbusClient, trace: Trace) -> str:
    link.open()
    header = trace.header(link)
    trace.refuse_other(header)
    return (
        f"{header.depth} records, one every {header.period_ns // 1000} µs; boot {header.boot}, "
        f"sequence {header.sequence}, PLC time {header.time_ns * 1e-9:.3f} s"
    )


def _records(link: ModbusClient, trace: Trace) -> str:
    link.open()
    header = trace.start(link)
    return f"the newest carry the header's sequence ({header.sequence})"


def _rate(link: ModbusClient, trace: Trace, clock: Clock) -> str:
    """Scans per second by this machine's clock; SourceError if they do not fit the period."""
    link.open()
    return watched(lambda: trace.header(link), clock)
