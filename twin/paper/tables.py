"""Tables 2 and 4 of the paper: each printed figure with the recomputed one."""

from collections.abc import Sequence
from dataclasses import dataclass

from twin.paper.evacuation import (
    APPLICATION,
    INSTANCE_SL_MIN,
    OBJECT_SL_MIN,
    RIG,
    Setup,
    Unit,
    equation_1,
    equation_2,
    evacuation_ms,
)

# What the paper prints, in ms, in the order of its tables.
PRINTED = ((RIG, (1569.0, 1403.0, 1164.0, 1113.0)), (APPLICATION, (315.0, 283.0, 230.0, 220.0)))
QUANTITIES = (
    "equation (1)",
    "equation (2) x 1.2",
    "model, object-specific",
    "model, instance-specific",
)


@dataclass(frozen=True)
class Row:
    """One figure of a table: as printed and as recomputed, in ms."""

    setup: Setup
    quantity: str
    paper_ms: float
    twin_ms: float

    @property
    def off_paper(self) -> float:
        """Excess of the recomputed time over the printed one, in %."""
        return percent_more(self.twin_ms, self.paper_ms)

    @property
    def json(self) -> dict[str, object]:
        """The row as a JSON document."""
        return {
            "system": self.setup.name,
            "quantity": self.quantity,
            "paper_ms": self.paper_ms,
            "twin_ms": round(self.twin_ms, 1),
        }


def percent_more(this: float, than: float) -> float:
    """Excess of ``this`` over ``than``, in %."""
    return 100.0 * (this / than - 1.0)


def recomputed() -> list[Row]:
    """All rows of both tables."""
    return [
        Row(setup, *row)
        for setup, printed in PRINTED
        for row in zip(QUANTITIES, printed, _times(setup), strict=True)
    ]


def late_by(rows: Sequence[Row]) -> float:
    """Delay (ms) of the printed over the recomputed rig model, with the unit's data."""
    (row,) = (row for row in rows if row.setup is RIG and row.quantity == QUANTITIES[-1])
    return row.paper_ms - row.twin_ms


def _times(setup: Setup) -> tuple[float, float, float, float]:
    return (
        equation_1(setup),
        equation_2(setup),
        evacuation_ms(setup, Unit(OBJECT_SL_MIN)),
        evacuation_ms(setup, Unit(INSTANCE_SL_MIN)),
    )
