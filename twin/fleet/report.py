"""What a fleet's answers come to: who needs attention first, what is wrong with them, and why.

Worst first: units are ranked by how far they stand from those like them; those whose logs were
diagnosed and not watched, by what the diagnosis found.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from twin.assets.record import Record
from twin.fleet.kinds import Estimate, estimates
from twin.fleet.peers import FEWEST_PEERS, Drift, Standing, standings
from twin.fleet.store import Result

FORMAT = "ejector-twin-fleet/1"
STANDS_OUT = 4.5  # sigmas from the others: one of a thousand units by chance, in twenty effects
DIAGNOSED = {"unlisted": 2, "explained": 2, "insufficient": 1, "consistent": 0}


@dataclass(frozen=True)
class Row:
    """One unit."""

    type: str
    id: str
    batch: str
    log: str  # the newest
    logs: int
    standing: Standing | None
    verdict: str  # of the newest diagnosis; empty where there is none
    causes: tuple[Mapping[str, Any], ...]
    leftover: float  # mbar rms that the twin is off in the newest diagnosis; 0 where there is none

    @property
    def drifts(self) -> tuple[Drift, ...]:
        """What moves from log to log."""
        return self.standing.drifts if self.standing else ()

    @property
    def noticed(self) -> bool:
        """Whether somebody should look at it."""
        if self.drifts:
            return True
        if self.standing is not None and self.standing.peers >= FEWEST_PEERS:
            return self.standing.beyond >= STANDS_OUT
        return DIAGNOSED.get(self.verdict, 0) == 2


@dataclass(frozen=True)
class Report:
    """All of a fleet, worst first."""

    rows: Sequence[Row]
    kinds: Mapping[str, Sequence[Estimate]]

    def groups(self) -> list[dict[str, Any]]:
        """By type and batch: how many units, how many of them are noticed, and the causes."""
        members: dict[tuple[str, str], list[Row]] = defaultdict(list)
        for row in self.rows:
            members[row.type, row.batch].append(row)
        return [
            {
                "type": kind,
                "batch": batch,
                "units": len(rows),
                "noticed": sum(row.noticed for row in rows),
                "causes": dict(Counter(cause_of(row) for row in rows if row.noticed).most_common()),
            }
            for (kind, batch), rows in sorted(members.items())
        ]

    def plain(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "format": FORMAT,
            "units": [_plain(rank, row) for rank, row in enumerate(self.rows, 1)],
            "groups": self.groups(),
            "types": {kind: [asdict(one) for one in every] for kind, every in self.kinds.items()},
        }


def report(results: Sequence[Result], records: Sequence[Record], at_ns: int) -> Report:
    """Put together what is known of a fleet."""
    watched = {(s.type, s.id): s for s in standings([r for r in results if r.key.work == "replay"])}
    every: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for one in results:
        every[one.type, one.id].append(one)
    rows = [_row(mine, watched.get(unit)) for unit, mine in every.items()]
    return Report(sorted(rows, key=_first, reverse=True), estimates(records, at_ns))


def cause_of(row: Row) -> str:
    """What is wrong: what the diagnosis names, else what it is most like."""
    if row.causes:
        return str(row.causes[0]["effect"])
    if row.verdict == "unlisted":
        return "unlisted"
    return row.standing.effect if row.standing else ""


def _row(mine: Sequence[Result], standing: Standing | None) -> Row:
    answers = [one for one in mine if one.key.work == "diagnose"]
    answer: Mapping[str, Any] = answers[-1].answer if answers else {}
    last = mine[-1]
    return Row(
        last.type,
        last.id,
        last.batch,
        last.log,
        len({one.key.log_sha256 for one in mine}),
        standing,
        answer.get("verdict", ""),
        tuple(answer.get("causes", ())),
        float((answer.get("baseline") or {}).get("rms_mbar", 0.0)),
    )


def _first(row: Row) -> tuple[float, ...]:
    """The greater, the earlier it is listed."""
    beyond = row.standing.beyond if row.standing else 0.0
    drift = max((one.sigmas for one in row.drifts), default=0.0)
    return float(row.noticed), max(beyond, drift), DIAGNOSED.get(row.verdict, 0), row.leftover


def _plain(rank: int, row: Row) -> dict[str, Any]:
    standing = row.standing
    return {
        "rank": rank,
        "type": row.type,
        "id": row.id,
        "batch": row.batch,
        "log": row.log,
        "logs": row.logs,
        "noticed": row.noticed,
        "cause": cause_of(row) if row.noticed else "",
        "beyond_sigmas": round(standing.beyond, 2) if standing else None,
        "effect": standing.effect if standing else None,
        "size": standing.size if standing else None,
        "unit": standing.unit if standing else None,
        "drifts": [asdict(one) for one in row.drifts],
        "verdict": row.verdict or None,
        "causes": [dict(one) for one in row.causes],
    }
