"""People's requests to an alarm, from another program or page; and how a board grants them."""

from dataclasses import dataclass

from twin.alarms.board import Board
from twin.alarms.state import SECOND_NS, Change, Deed
from twin.errors import ConfigError

ASKABLE = (
    Deed.ACKNOWLEDGED,
    Deed.SHELVED,
    Deed.UNSHELVED,
    Deed.OUT_OF_SERVICE,
    Deed.IN_SERVICE,
)


@dataclass(frozen=True, slots=True)
class Request:
    """One person's request; ``seconds`` is the time to shelve for, from ``asked_ns`` on."""

    id: int
    alarm: str
    deed: Deed
    who: str
    asked_ns: int
    seconds: float = 0.0


def grant(board: Board, request: Request, now: int) -> list[Change]:
    """Carry out a request; ConfigError if that is not possible."""
    alarm, who = board[request.alarm], request.who
    match request.deed:
        case Deed.ACKNOWLEDGED:
            return list(alarm.acknowledge(now, who))
        case Deed.SHELVED:
            waited = max(0, now - request.asked_ns) / SECOND_NS
            if waited >= request.seconds:
                raise ConfigError(f"{request.alarm}: the time to shelve it for is over already")
            return list(alarm.shelve(now, request.seconds - waited, who))
        case Deed.UNSHELVED:
            return list(alarm.unshelve(now, who))
        case Deed.OUT_OF_SERVICE | Deed.IN_SERVICE:
            return list(alarm.serve(now, request.deed is Deed.IN_SERVICE, who))
    raise ConfigError(f"{request.deed} is nothing that can be asked of an alarm")
