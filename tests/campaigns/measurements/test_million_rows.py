"""The way of a large database through an upgrade, a backup and a restore, with fewer rows than the command takes."""

import pytest

from tests.campaigns.measurements.million_rows import go_through


@pytest.mark.both_databases
def test_rows_of_an_old_database_are_upgraded_backed_up_and_restored_with_their_chain(
    empty_place, tmp_path, capsys, other_place
):
    assert go_through(empty_place, other_place, tmp_path, rows=20_000, samples=1_000)
    printed = capsys.readouterr().out
    assert printed.count("chain: intact") == 2
    assert "chain: intact, 20,001 rows" in printed
    assert len(list((tmp_path / "data" / "samples").glob("*.parquet"))) == 1


@pytest.fixture
def other_place(empty_place, tmp_path):
    """Restore into a file, whatever it came from."""
    return tmp_path / "restored.db"
