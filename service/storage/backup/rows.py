"""Rows as JSON lines, ordered by primary key; byte for byte the same from SQLite and PostgreSQL."""

import base64
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import cast

from sqlalchemy import (
    Boolean,
    Column,
    ColumnElement,
    Connection,
    Double,
    Float,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    collate,
    func,
    insert,
    select,
)

from service.storage.backup.layout import LEFT_OUT, BackupError, TablePart
from service.storage.database.migrations import VERSION_TABLE

PIECE = 1000
LAST = ("qa_outcomes",)
"""Tables to insert last: a trigger refuses results of a QA run that has an outcome."""

Encode = Callable[[object], object]
OnRows = Callable[[int], None]


@dataclass(slots=True)
class Digest:
    """Row count and SHA-256 of a table's lines."""

    rows: int = 0
    _hash: "hashlib._Hash" = field(default_factory=hashlib.sha256)

    def add(self, line: bytes) -> bytes:
        """Add one line and return it."""
        self.rows += 1
        self._hash.update(line)
        return line

    def part(self, table: Table) -> TablePart:
        """Return the manifest's entry for a table."""
        columns = [column.name for column in table.columns]
        return TablePart(name=table.name, columns=columns, rows=self.rows, sha256=self._hash.hexdigest())


def tables_of(connection: Connection) -> list[Table]:
    """Return the tables to back up, in an order that satisfies foreign keys on insert."""
    found = MetaData()
    found.reflect(connection)
    kept = [table for table in found.sorted_tables if table.name not in (VERSION_TABLE, *LEFT_OUT)]
    return sorted(kept, key=lambda table: table.name in LAST)


def count(connection: Connection, table: Table) -> int:
    """Return the number of a table's rows."""
    return connection.scalar(select(func.count()).select_from(table)) or 0


def lines(connection: Connection, table: Table) -> Iterator[bytes]:
    """Yield a table's rows as JSON lines; rows are fetched in pieces."""
    encoders = [_encoder(column) for column in table.columns]
    query = select(table).order_by(*(_key(connection, column) for column in table.primary_key))
    for row in connection.execute(query, execution_options={"yield_per": PIECE}):
        values = [encode(value) for encode, value in zip(encoders, row, strict=True)]
        yield json.dumps(values, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode() + b"\n"


def digest_of(connection: Connection, table: Table, on_rows: OnRows) -> TablePart:
    """Return the manifest's entry of a table as a backup would write it."""
    digest = Digest()
    for line in lines(connection, table):
        digest.add(line)
        if digest.rows % PIECE == 0:
            on_rows(PIECE)
    on_rows(digest.rows % PIECE)
    return digest.part(table)


def add_lines(connection: Connection, table: Table, part: TablePart, source: Iterable[bytes], on_rows: OnRows) -> None:
    """Insert rows from their lines; raise BackupError for other columns, ValueError for malformed lines."""
    names = [column.name for column in table.columns]
    if sorted(names) != sorted(part.columns):
        msg = f"the backup's table {table.name} has other columns than revision's"
        raise BackupError(msg)
    decoders = [_decoder(table.columns[name]) for name in part.columns]
    rows: list[dict[str, object]] = []
    for line in source:
        values = json.loads(line)
        rows.append({name: decode(value) for name, decode, value in zip(part.columns, decoders, values, strict=True)})
        if len(rows) == PIECE:
            _add(connection, table, rows, on_rows)
    _add(connection, table, rows, on_rows)


def _add(connection: Connection, table: Table, rows: list[dict[str, object]], on_rows: OnRows) -> None:
    if rows:
        connection.execute(insert(table), rows)
        on_rows(len(rows))
        rows.clear()


def _key(connection: Connection, column: Column[object]) -> ColumnElement[object]:
    """Order text by its bytes, as SQLite does; PostgreSQL would order by its locale."""
    is_foreign_order = isinstance(column.type, String) and connection.dialect.name == "postgresql"
    return cast("ColumnElement[object]", collate(column, "C")) if is_foreign_order else column


def _encoder(column: Column[object]) -> Encode:
    if isinstance(column.type, LargeBinary):
        return lambda value: None if value is None else base64.b64encode(bytes(value)).decode()  # type: ignore[call-overload]
    if isinstance(column.type, Double | Float):
        return lambda value: str(value) if isinstance(value, float) and not math.isfinite(value) else value
    if isinstance(column.type, String | Integer | Boolean):
        return lambda value: value
    msg = f"column {column.table.name}.{column.name} is of a type that backups do not know: {column.type}"
    raise BackupError(msg)


def _decoder(column: Column[object]) -> Encode:
    if isinstance(column.type, LargeBinary):
        return lambda value: base64.b64decode(value, validate=True) if isinstance(value, str) else value
    if isinstance(column.type, Double | Float):
        return lambda value: float(value) if isinstance(value, str) else value
    return lambda value: value
