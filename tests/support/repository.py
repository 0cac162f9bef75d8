"""Where the repository and the test data lie, for tests and their programs."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The folder with the Makefile, `engine`, `service`, `docs` and `tests`."""

DATA = ROOT / "tests" / "data"
"""Recorded traces, and files that earlier versions wrote."""
