"""Speed and memory benchmark: frame path by stage, the plain method, decoding, learning, batch runs, memory.

Each part runs in a fresh process on given cores, configured as the service configures itself. The pipeline is measured
unmodified: stages are timed by wrapping their names from outside, the whole frame without any wrapper.
"""
