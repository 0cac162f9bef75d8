"""Memory by library, from the text of ``/proc/PID/smaps``."""

import os

import pytest

from tests.campaigns.measurements.memory_by_library import OWN_MEMORY, by_library, library_of, table

SMAPS = """\
7f00-7f10 r-xp 00000000 00:01 7 /v/lib/python3.11/site-packages/numpy.libs/libopenblas-1.so
Rss:                2000 kB
Pss:                1000 kB
VmFlags: rd ex mr mw me
7f10-7f20 rw-p 00000000 00:00 0
Pss:                 500 kB
7f20-7f30 rw-p 00000000 00:00 0 [heap]
Pss:                 250 kB
"""


def test_mappings_of_one_library_are_summed_up():
    found = by_library(SMAPS)
    assert found == pytest.approx({"numpy": 1.024, OWN_MEMORY: 0.768})
    assert by_library("") == {}


@pytest.mark.parametrize(
    ("name", "library"),
    [
        ("", OWN_MEMORY),
        ("[heap]", OWN_MEMORY),
        ("[stack]", "stacks"),
        ("/memfd:tidegate-engine (deleted)", "shared memory"),
        ("/v/site-packages/cv2/cv2.abi3.so", "cv2"),
        ("/v/site-packages/_cffi_backend.so", "_cffi_backend"),
        ("/usr/lib/libcrypto.so.3", "libcrypto"),
        ("/usr/bin/python3.11", "Python"),
    ],
)
def test_a_mapping_belongs_to_the_library_of_its_file(name, library):
    assert library_of(name) == library


def test_the_table_of_a_process_adds_up():
    rows = [line.split() for line in table(os.getpid()).splitlines()[1:]]
    assert rows[-1][-1] == "all"
    assert 0.0 < sum(float(row[0]) for row in rows[:-1]) <= float(rows[-1][0])
