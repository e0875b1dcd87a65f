"""The unit as a key: tables hold the rows of several units."""

from typing import NamedTuple

from sqlalchemy import ColumnElement, Table


class Unit(NamedTuple):
    """One ejector."""

    type: str
    id: str


def of_unit(table: Table, unit: Unit) -> tuple[ColumnElement[bool], ...]:
    """Conditions for the rows of a unit in a table with ``asset_type`` and ``asset_id``."""
    return table.c.asset_type == unit.type, table.c.asset_id == unit.id
