"""Fixtures of several packages are in tests/support/fixtures; what a run takes, in tests/support/selection.py."""

import pytest

pytest.register_assert_rewrite("tests.support")

pytest_plugins = [
    "pytester",
    "tests.support.fixtures.audit",
    "tests.support.fixtures.databases",
    "tests.support.fixtures.department",
    "tests.support.fixtures.process",
    "tests.support.fixtures.recordings",
    "tests.support.fixtures.samples",
    "tests.support.selection",
    "tests.support.temporary_folder",
]
