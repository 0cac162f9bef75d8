"""Pure functions of one frame's way; siblings that never import each other.

Same input, same output: no clock, no log, no settings object, no I/O. A recording replays bit for bit.
"""
