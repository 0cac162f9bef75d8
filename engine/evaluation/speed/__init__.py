"""How fast it is: a frame's way stage by stage, the plain reading beside it, decoding, learning, batch runs, memory.

Each part runs in a fresh process on the cores it is told of, set up as the service sets itself up. The pipeline is
measured as it stands: its stages are timed by wrapping their names from outside, the whole frame without any wrapping.
"""
