"""What a fleet's answers come to: who needs attention first, what is wrong with them, and why.

Worst first: units are ranked by how far they stand from those like them; those whose logs were
diagnosed and not watched, by what the diagnosis found.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from twin.assets.record import Record
from twin.fleet.peers import FEWEST_PEERS, Drift, Standing, standings
from twin.fleet.results_database import Result
from twin.fleet.type_statistics import Estimate, estimates

FORMAT = "ejector-twin-fleet/2"
STANDS_OUT = 4.5  # sigmas from the others: one of a thousand units by chance, in twenty effects
DIAGNOSED = {"unlisted": 2, "explained": 2, "insufficient": 1, "consistent": 0}


class State(StrEnum):
    """What is known of a unit."""

    STANDS_OUT = "stands_out"  # somebody should look at it
    DOES_NOT = "does_not"  # it was judged, and nothing is found
    NOT_JUDGED = "not_judged"  # nobody knows


@dataclass(frozen=True)
class Row:
    """One unit. ``reason`` says why it could not be judged, and is empty where it was."""

    type: str
    id: str
    batch: str
    log: str  # the newest
    log_complete: bool  # otherwise it was cut off, and the unit is judged by what is there
    logs: int
    state: State
    reason: str
    standing: Standing | None
    verdict: str  # of the newest diagnosis; empty where there is none
    causes: tuple[Mapping[str, Any], ...]
    leftover: float  # mbar rms that the twin is off in the newest diagnosis; 0 where there is none

    @property
    def stands_out(self) -> bool:
        """Whether somebody should look at it."""
        return self.state is State.STANDS_OUT

    @property
    def compared(self) -> Standing | None:
        """How far it is from the others, where there are enough of them to compare it with."""
        enough = self.standing is not None and self.standing.peers >= FEWEST_PEERS
        return self.standing if enough else None

    @property
    def drifts(self) -> tuple[Drift, ...]:
        """What moves from log to log."""
        return self.standing.drifts if self.standing else ()


@dataclass(frozen=True)
class Refused:
    """A log that nothing could be done with, and why."""

    log: str
    why: str


@dataclass(frozen=True)
class Report:
    """All of a fleet, worst first, and the logs that are missing in it."""

    rows: Sequence[Row]
    kinds: Mapping[str, Sequence[Estimate]]
    refused: Sequence[Refused] = ()

    def of(self, state: State) -> list[Row]:
        """The units in a state."""
        return [row for row in self.rows if row.state is state]

    def cut(self) -> list[Row]:
        """The units whose newest log was cut off."""
        return [row for row in self.rows if not row.log_complete]

    def groups(self) -> list[dict[str, Any]]:
        """By type and batch: how many units there are, in each state and cut off, and causes."""
        members: dict[tuple[str, str], list[Row]] = defaultdict(list)
        for row in self.rows:
            members[row.type, row.batch].append(row)
        return [
            {
                "type": kind,
                "batch": batch,
                "units": len(rows),
                **{state.value: sum(row.state is state for row in rows) for state in State},
                "log_cut": sum(not row.log_complete for row in rows),
                "causes": dict(
                    Counter(cause_of(row) for row in rows if row.stands_out).most_common()
                ),
            }
            for (kind, batch), rows in sorted(members.items())
        ]

    def plain(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "format": FORMAT,
            "units": [_plain(rank, row) for rank, row in enumerate(self.rows, 1)],
            "groups": self.groups(),
            "refused": [asdict(one) for one in self.refused],
            "types": {kind: [asdict(one) for one in every] for kind, every in self.kinds.items()},
        }


def report(
    results: Sequence[Result],
    records: Sequence[Record],
    at_ns: int,
    refused: Sequence[Refused] = (),
) -> Report:
    """Put together what is known of a fleet at a time (UTC, ns)."""
    watched = {(s.type, s.id): s for s in standings([r for r in results if r.key.work == "replay"])}
    every: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for one in results:
        every[one.type, one.id].append(one)
    rows = [_row(mine, watched.get(unit)) for unit, mine in every.items()]
    return Report(sorted(rows, key=_first, reverse=True), estimates(records, at_ns), refused)


def cause_of(row: Row) -> str:
    """What is wrong: what the diagnosis names, else what it is most like."""
    if row.causes:
        return str(row.causes[0]["effect"])
    if row.verdict == "unlisted":
        return "unlisted"
    return row.standing.effect if row.standing else ""


def _row(mine: Sequence[Result], standing: Standing | None) -> Row:
    answers = [one for one in mine if one.key.work == "diagnose"]
    newest = answers[-1] if answers else None
    answer: Mapping[str, Any] = newest.answer if newest else {}
    last = mine[-1]
    state, reason = _judged(standing, newest, last)
    return Row(
        last.type,
        last.id,
        last.batch,
        last.log,
        last.complete,
        len({one.key.log_sha256 for one in mine}),
        state,
        reason,
        standing,
        answer.get("verdict", ""),
        tuple(answer.get("causes", ())),
        float((answer.get("baseline") or {}).get("rms_mbar") or 0.0),
    )


def _judged(standing: Standing | None, newest: Result | None, last: Result) -> tuple[State, str]:
    """A unit's state by those like it, else by its newest diagnosis; or why it has none.

    What was well in an older log says nothing of the last one.
    """
    if standing is not None and standing.drifts:
        return State.STANDS_OUT, ""
    current = standing is not None and standing.log == last.log
    if standing is not None and current and standing.peers >= FEWEST_PEERS:
        return (State.STANDS_OUT if standing.beyond >= STANDS_OUT else State.DOES_NOT), ""
    if newest is not None and (found := _diagnosed(newest, last)) is not None:
        return found
    if standing is None or not current:
        return State.NOT_JUDGED, "no cycle of its newest log can be compared"
    units = "1 unit" if standing.peers == 1 else f"{standing.peers} units"
    few = f"{units} to compare, {FEWEST_PEERS} are needed"
    return State.NOT_JUDGED, f"{few}; its newest log is not diagnosed yet"


def _diagnosed(newest: Result, last: Result) -> tuple[State, str] | None:
    """The same by the newest diagnosis; None where it says nothing of the last log."""
    verdict = newest.answer["verdict"]
    if DIAGNOSED[verdict] == 2:
        return State.STANDS_OUT, ""
    if newest.key.log_sha256 != last.key.log_sha256:
        return None
    if verdict == "consistent":
        return State.DOES_NOT, ""
    return State.NOT_JUDGED, f"no diagnosis: {newest.answer['next_experiment']}"


def _first(row: Row) -> tuple[float, ...]:
    """The greater, the earlier it is listed."""
    beyond = row.standing.beyond if row.standing else 0.0
    drift = max((one.sigmas for one in row.drifts), default=0.0)
    rank = (State.DOES_NOT, State.NOT_JUDGED, State.STANDS_OUT).index(row.state)
    return float(rank), max(beyond, drift), DIAGNOSED.get(row.verdict, 0), row.leftover


def _plain(rank: int, row: Row) -> dict[str, Any]:
    standing = row.standing
    return {
        "rank": rank,
        "type": row.type,
        "id": row.id,
        "batch": row.batch,
        "log": row.log,
        "log_complete": row.log_complete,
        "logs": row.logs,
        "state": row.state.value,
        "reason": row.reason or None,
        "cause": cause_of(row) if row.stands_out else "",
        "peers": standing.peers if standing else 0,
        "beyond_sigmas": round(standing.beyond, 2) if standing else None,
        "effect": standing.effect if standing else None,
        "size": standing.size if standing else None,
        "unit": standing.unit if standing else None,
        "drifts": [asdict(one) for one in row.drifts],
        "verdict": row.verdict or None,
        "causes": [dict(one) for one in row.causes],
    }
