"""Batch measurement of recordings, and replay of recorded sessions."""
