"""The database: SQLite in WAL mode, its tables, and the questions the service asks of them."""
