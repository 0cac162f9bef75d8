"""Rows for tables of any revision, made from what the database says of itself."""

from typing import Any

from sqlalchemy import (
    Boolean,
    Column,
    Connection,
    Double,
    Float,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    func,
    insert,
    select,
)

VERSION_TABLE = "alembic_version"
LAST = ("qa_outcomes",)
"""A QA run that has ended takes no more results."""

Contents = dict[str, list[dict[str, Any]]]


def tables(connection: Connection) -> list[Table]:
    """Read which tables there are, in an order that rows can be added in."""
    found = MetaData()
    found.reflect(connection)
    return sorted((t for t in found.sorted_tables if t.name != VERSION_TABLE), key=lambda table: table.name in LAST)


def add_rows(connection: Connection, *, but: tuple[str, ...] = ()) -> None:
    """Add one row to every table; the n-th row of a table is the same in every database."""
    for table in tables(connection):
        if table.name in but:
            continue
        number = 1 + (connection.scalar(select(func.count()).select_from(table)) or 0)
        row = {column.name: _value(connection, column, number) for column in table.columns}
        connection.execute(insert(table).values(row))


def contents(connection: Connection) -> Contents:
    """Read all rows of all tables."""
    return {
        table.name: [dict(row) for row in connection.execute(select(table).order_by(*table.primary_key)).mappings()]
        for table in tables(connection)
    }


def shared(one: Contents, other: Contents) -> tuple[Contents, Contents]:
    """Reduce both to the tables and columns that both have."""
    names = one.keys() & other.keys()
    return _reduced(one, other, names), _reduced(other, one, names)


def _reduced(one: Contents, other: Contents, names: set[str]) -> Contents:
    found = {}
    for name in names:
        columns = one[name][0].keys() & other[name][0].keys() if one[name] and other[name] else set()
        found[name] = [{column: row[column] for column in sorted(columns)} for row in one[name]]
    return found


def _value(connection: Connection, column: Column[Any], number: int) -> object:
    for key in column.foreign_keys:
        return connection.scalar(select(func.max(key.column)))
    kind = column.type
    if isinstance(kind, Boolean):
        return number % 2 == 0
    if isinstance(kind, Integer):
        return 2**40 + number if column.name.endswith(("_ns", "_us")) else number
    if isinstance(kind, Double | Float):
        return number / 8.0
    if isinstance(kind, LargeBinary):
        return bytes([0, 255, number, 64])  # four bytes: a number of single precision
    text = f"{column.name} ÄÖ {number}"
    length = getattr(kind, "length", None)
    return text if length is None else f"{number}-{text}"[:length]
