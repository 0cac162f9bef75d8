"""Alarms of the running session: what, how urgent, since when, acknowledged by whom (docs/2-clinical/alarms.md)."""
