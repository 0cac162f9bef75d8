"""Values in memory files: whole or refused, with read-only arrays."""

import os
import struct

import numpy as np
import pytest

from engine.motion.training_process.server import (
    ALIGNMENT,
    SharedValueError,
    make_file,
    read_value,
    write_value,
)


@pytest.fixture
def file():
    made = make_file()
    yield made
    os.close(made)


def test_a_value_comes_back_with_its_arrays_aligned_and_read_only(file):
    shapes = [(7,), (3, 5), (0,), (175, 100), ()]
    arrays = [
        np.random.default_rng(0).normal(size=shape).astype(kind) for shape in shapes for kind in ("f4", "f8", "?")
    ]
    write_value(file, [{"arrays": arrays, "again": arrays[0], "text": "x"}])
    found = read_value(file)
    assert found["text"] == "x"
    assert found["again"] is found["arrays"][0]
    for array, expected in zip(found["arrays"], arrays, strict=True):
        assert array.dtype == expected.dtype
        assert np.array_equal(array, expected)
        assert not array.flags.writeable
        assert array.size == 0 or array.ctypes.data % ALIGNMENT == 0


def test_more_arrays_than_one_call_takes_are_written_whole(file):
    arrays = [np.full(3, number) for number in range(3000)]
    write_value(file, [arrays])
    assert np.array_equal(np.array(read_value(file)), np.array(arrays))


def test_the_memory_stays_while_an_array_is_used(file):
    write_value(file, [[np.arange(100_000), np.arange(5)]])
    kept = read_value(file)[1]
    os.ftruncate(make_file(), 0)
    assert kept.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("size", [0, 1, 15, 16, 63, 64, 128, 1000, -64, -1])
def test_a_file_that_was_not_written_to_its_end_is_refused(file, size):
    write_value(file, [[np.arange(1000)]])
    os.ftruncate(file, size if size >= 0 else os.fstat(file).st_size + size)
    with pytest.raises(SharedValueError):
        read_value(file)


def test_other_content_is_refused(file):
    os.write(file, struct.pack("<8sQ", b"another ", 1) + bytes(112))
    with pytest.raises(SharedValueError, match="damaged"):
        read_value(file)


def test_what_cannot_be_written_whole_is_an_error(file):
    limited = os.open(f"/proc/self/fd/{file}", os.O_RDONLY)
    try:
        with pytest.raises(SharedValueError, match="another process"):
            write_value(limited, [np.arange(10)])
    finally:
        os.close(limited)
