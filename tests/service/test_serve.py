"""What `tidegate serve` does to its own process."""

import gc

from service.cli.serve import _set_memory_aside


def test_what_was_there_at_the_start_is_collected_no_more():
    kept = [[] for _ in range(1000)]
    try:
        _set_memory_aside()
        assert gc.get_freeze_count() > len(kept)
        assert not any(item is kept for item in gc.get_objects())
    finally:
        gc.unfreeze()
