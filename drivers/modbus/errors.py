"""Errors of Modbus requests: what is wrong, at which addresses of which PLC, and what to do."""

from drivers.reconnect import AbsentError, LostError
from drivers.tags import Address
from twin.errors import SourceError

EXCEPTIONS = {
    1: "illegal function: it does not serve this kind of address",
    2: "illegal data address: it does not serve this address",
    3: "illegal data value: it does not serve this many at once",
    4: "device failure",
    5: "acknowledged, not ready",
    6: "busy",
    8: "memory parity error",
    10: "gateway: no path to the unit",
    11: "gateway: the unit does not answer",
}
OURS = (1, 3)  # the request is wrong and stays wrong; the others may pass
ABSENT = 2  # it may come later: a PLC that starts or takes a new program does not serve it yet


def lost(where: str, address: Address, count: int, cause: str) -> LostError:
    """The error for a request without a valid answer."""
    return LostError(
        f"{where}: {span(address, count)}: {cause}",
        "is the unit id right, is it a Modbus TCP server, does it answer within timeout_ms? "
        "A secure port (often 802) needs [driver.tls]",
    )


def refused(where: str, address: Address, count: int, code: int) -> SourceError:
    """The error for an answer with an exception: LostError unless the request itself is at fault.

    AbsentError if the PLC does not serve the address.
    """
    cause = EXCEPTIONS.get(code, "an exception unknown to the protocol")
    text = f"{where}: {span(address, count)}: {cause} (Modbus exception {code})"
    if code not in (*OURS, ABSENT):
        return LostError(text, "is the unit id right, and does the PLC run?")
    kind = AbsentError if code == ABSENT else SourceError
    return kind(
        text,
        "check the addresses in [driver]: holding:0 counts from 0, the manual's 40001 from 1; "
        "everything read at once must exist",
    )


def span(address: Address, count: int) -> str:
    """Several addresses in both notations."""
    if count == 1:
        return str(address)
    last = address + (count - 1)
    return f"{address.area}:{address.offset}–{last.offset} [{address.manual}–{last.manual}]"
