"""People's requests, from another program or page: to an alarm, and to change a limit."""

from dataclasses import dataclass

from twin.alarms.board import Board
from twin.alarms.state import SECOND_NS, AlarmAction, Change
from twin.errors import ConfigError

ASKABLE = (
    AlarmAction.ACKNOWLEDGED,
    AlarmAction.SHELVED,
    AlarmAction.UNSHELVED,
    AlarmAction.OUT_OF_SERVICE,
    AlarmAction.IN_SERVICE,
)


@dataclass(frozen=True, slots=True)
class Request:
    """One person's request; ``seconds`` is the time to shelve for, from ``asked_ns`` on."""

    id: int
    alarm: str
    action: AlarmAction
    who: str
    asked_ns: int
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class LimitChange:
    """One person's change of a limit, named by its key; without ``value`` back to the configured.

    ``old`` and ``new`` are the values in force before and after a run applied it, in the limit's
    unit; None where there is no limit.
    """

    id: int
    limit: str
    value: float | None
    who: str
    reason: str
    asked_ns: int
    answered_ns: int | None = None
    refusal: str = ""  # why a run refused it
    old: float | None = None
    new: float | None = None

    @property
    def is_waiting(self) -> bool:
        """Whether no run has applied or refused it yet."""
        return self.answered_ns is None

    @property
    def is_applied(self) -> bool:
        """Whether a run has applied it."""
        return self.answered_ns is not None and not self.refusal


def grant(board: Board, request: Request, now: int) -> list[Change]:
    """Carry out a request; ConfigError if that is not possible."""
    alarm, who = board[request.alarm], request.who
    match request.action:
        case AlarmAction.ACKNOWLEDGED:
            return list(alarm.acknowledge(now, who))
        case AlarmAction.SHELVED:
            waited = max(0, now - request.asked_ns) / SECOND_NS
            if waited >= request.seconds:
                raise ConfigError(f"{request.alarm}: the time to shelve it for is over already")
            return list(alarm.shelve(now, request.seconds - waited, who))
        case AlarmAction.UNSHELVED:
            return list(alarm.unshelve(now, who))
        case AlarmAction.OUT_OF_SERVICE | AlarmAction.IN_SERVICE:
            return list(alarm.serve(now, request.action is AlarmAction.IN_SERVICE, who))
    raise ConfigError(f"{request.action} is nothing that can be asked of an alarm")
