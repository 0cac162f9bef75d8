"""Values and words that every engine package shares.

Frames, motion model, signals, gate states, commands, errors, clock, strict files.
"""
