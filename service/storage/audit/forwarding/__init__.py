"""Audit events forwarded to a syslog server."""
