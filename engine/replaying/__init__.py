"""Tapes of what an engine heard, and the same session heard again from one (ADR 0013)."""
