"""The unit as a key: tables hold the rows of several units."""

from typing import Any, NamedTuple

from sqlalchemy import Column, ColumnElement, Table, Text


class Unit(NamedTuple):
    """One ejector."""

    type: str
    id: str


def unit_columns(*, in_key: bool) -> tuple[Column[Any], Column[Any]]:
    """Columns that say whose rows they are; ``in_key`` is for those of the primary key."""
    return (
        Column("asset_type", Text, primary_key=in_key, nullable=False),
        Column("asset_id", Text, primary_key=in_key, nullable=False),
    )


def of_unit(table: Table, unit: Unit) -> tuple[ColumnElement[bool], ...]:
    """Conditions for the rows of a unit in a table with ``asset_type`` and ``asset_id``."""
    return table.c.asset_type == unit.type, table.c.asset_id == unit.id
