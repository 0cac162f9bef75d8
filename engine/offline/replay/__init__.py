"""Tapes of an engine's inputs, and sessions replayed from them (ADR 0013)."""
