"""Backups: one file with a data folder and its database, in the same format for SQLite and PostgreSQL.

See docs/3-operate/databases.md.
"""
