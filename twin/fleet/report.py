"""The report of a fleet: which units need attention first, and what is wrong with them.

Units are ranked by their distance from their peers, the worst first. Units whose logs were
diagnosed but not watched are ranked by their diagnosis.
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
    """The judgement of a unit."""

    STANDS_OUT = "stands_out"  # a person should look at it
    DOES_NOT = "does_not"  # it was judged as normal
    NOT_JUDGED = "not_judged"  # there is no judgement


@dataclass(frozen=True)
class Row:
    """One unit. ``reason`` says why it could not be judged; it is empty if it was."""

    type: str
    id: str
    batch: str
    log: str  # the newest
    log_complete: bool  # otherwise it was cut off, and the unit is judged by the rest
    logs: int
    state: State
    reason: str
    standing: Standing | None
    verdict: str  # of the newest diagnosis; empty without one
    causes: tuple[Mapping[str, Any], ...]
    residual_rms: float  # mbar rms of the twin's error in the newest diagnosis; 0 without one

    @property
    def stands_out(self) -> bool:
        """Whether a person should look at it."""
        return self.state is State.STANDS_OUT

    @property
    def compared(self) -> Standing | None:
        """Its distance from its peers; None if there are too few of them."""
        enough = self.standing is not None and self.standing.peers >= FEWEST_PEERS
        return self.standing if enough else None

    @property
    def drifts(self) -> tuple[Drift, ...]:
        """Its drifts from log to log."""
        return self.standing.drifts if self.standing else ()


@dataclass(frozen=True)
class Refused:
    """A log that could not be used, and why."""

    log: str
    why: str


@dataclass(frozen=True)
class Report:
    """All units of a fleet, the worst first, and the logs that could not be used."""

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
        """Counts by type and batch: units, units in each state, cut-off logs, and causes."""
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
        """The report as a JSON document."""
        return {
            "format": FORMAT,
            "units": [_plain(rank, row) for rank, row in enumerate(self.rows, 1)],
            "groups": self.groups(),
            "refused": [asdict(item) for item in self.refused],
            "types": {
                kind: [asdict(item) for item in estimates] for kind, estimates in self.kinds.items()
            },
        }


def report(
    results: Sequence[Result],
    records: Sequence[Record],
    at_ns: int,
    refused: Sequence[Refused] = (),
) -> Report:
    """The report of a fleet at a time (UTC, ns)."""
    watched = {
        (standing.type, standing.id): standing
        for standing in standings([result for result in results if result.key.work == "replay"])
    }
    by_unit: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for result in results:
        by_unit[result.type, result.id].append(result)
    rows = [_row(unit_results, watched.get(unit)) for unit, unit_results in by_unit.items()]
    return Report(sorted(rows, key=_sort_key, reverse=True), estimates(records, at_ns), refused)


def cause_of(row: Row) -> str:
    """The cause: the diagnosed one, else the effect in which the unit is furthest."""
    if row.causes:
        return str(row.causes[0]["effect"])
    if row.verdict == "unlisted":
        return "unlisted"
    return row.standing.effect if row.standing else ""


def _row(results: Sequence[Result], standing: Standing | None) -> Row:
    answers = [result for result in results if result.key.work == "diagnose"]
    newest = answers[-1] if answers else None
    answer: Mapping[str, Any] = newest.answer if newest else {}
    last = results[-1]
    state, reason = _judged(standing, newest, last)
    return Row(
        last.type,
        last.id,
        last.batch,
        last.log,
        last.complete,
        len({result.key.log_sha256 for result in results}),
        state,
        reason,
        standing,
        answer.get("verdict", ""),
        tuple(answer.get("causes", ())),
        float((answer.get("baseline") or {}).get("rms_mbar") or 0.0),
    )


def _judged(standing: Standing | None, newest: Result | None, last: Result) -> tuple[State, str]:
    """A unit's state by its peers, else by its newest diagnosis; or why it has none.

    A good result of an older log says nothing about the last one.
    """
    if standing is not None and standing.drifts:
        return State.STANDS_OUT, ""
    current = standing is not None and standing.log == last.log
    if standing is not None and current and standing.peers >= FEWEST_PEERS:
        return (State.STANDS_OUT if standing.beyond >= STANDS_OUT else State.DOES_NOT), ""
    if newest is not None and (judgement := _diagnosed(newest, last)) is not None:
        return judgement
    if standing is None or not current:
        return State.NOT_JUDGED, "no cycle of its newest log can be compared"
    unit = "unit" if standing.peers == 1 else "units"
    return (
        State.NOT_JUDGED,
        f"{standing.peers} {unit} to compare, {FEWEST_PEERS} are needed; its newest log is not"
        " diagnosed yet",
    )


def _diagnosed(newest: Result, last: Result) -> tuple[State, str] | None:
    """A unit's state by its newest diagnosis; None if that says nothing about the last log."""
    verdict = newest.answer["verdict"]
    if DIAGNOSED[verdict] == 2:
        return State.STANDS_OUT, ""
    if newest.key.log_sha256 != last.key.log_sha256:
        return None
    if verdict == "consistent":
        return State.DOES_NOT, ""
    return State.NOT_JUDGED, f"no diagnosis: {newest.answer['next_experiment']}"


def _sort_key(row: Row) -> tuple[float, ...]:
    """The sort key of a row; greater keys are listed first."""
    beyond = row.standing.beyond if row.standing else 0.0
    drift_sigmas = max((drift.sigmas for drift in row.drifts), default=0.0)
    rank = (State.DOES_NOT, State.NOT_JUDGED, State.STANDS_OUT).index(row.state)
    return float(rank), max(beyond, drift_sigmas), DIAGNOSED.get(row.verdict, 0), row.residual_rms


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
        "drifts": [asdict(item) for item in row.drifts],
        "verdict": row.verdict or None,
        "causes": [dict(item) for item in row.causes],
    }
