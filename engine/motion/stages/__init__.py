"""Stages of the frame path: pure functions that do not import each other.

They use no clock, log, settings object or I/O, so a recording replays bit for bit on one processor.
"""
