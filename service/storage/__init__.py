"""Persistent data: database, audit log, samples, backups and files in the data folder."""
