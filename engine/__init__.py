"""The real-time half of Tidegate: from depth frames to a gated beam.

Plain numpy and OpenCV. Nothing here depends on a web framework, a database or an event loop, so everything here can be
replayed, profiled and mutated alone.
"""

__version__ = "0.2.0"
