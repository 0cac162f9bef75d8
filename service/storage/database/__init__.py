"""The database, on SQLite or PostgreSQL: connections, tables, migrations and queries."""
