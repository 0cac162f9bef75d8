"""Backups: one file with all of a data folder and its database, the same for both databases (docs/databases.md)."""
