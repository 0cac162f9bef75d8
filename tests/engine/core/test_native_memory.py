import subprocess
import sys

# A process of its own: what the heap looks like, and what was set, would otherwise be other tests' doing.
PROGRAM = """
import resource, sys
import numpy as np
from engine.core.native_process import keep_freed_memory
if sys.argv[1] == "kept":
    keep_freed_memory()
def frame():
    arrays = [np.full(1_228_800, 1, np.uint8) for _ in range(3)]
for _ in range(5):
    frame()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    frame()
print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) // 20)
"""


def faults_a_frame(setting):
    ran = subprocess.run([sys.executable, "-c", PROGRAM, setting], capture_output=True, text=True, check=True)
    return int(ran.stdout)


def test_frames_that_follow_use_the_memory_of_those_before():
    assert faults_a_frame("kept") < 50 < faults_a_frame("given back")


GIVING_BACK = """
import numpy as np
from engine.core.native_process import give_freed_memory_back, keep_freed_memory
def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6
keep_freed_memory()
pieces = [np.ones(200_000, np.uint8) for _ in range(600)]
pieces = pieces[::10]
before = resident_mb()
give_freed_memory_back()
print(int(before - resident_mb()))
"""


def test_what_lies_free_between_pieces_that_stay_is_given_back():
    ran = subprocess.run([sys.executable, "-c", GIVING_BACK], capture_output=True, text=True, check=True)
    assert int(ran.stdout) > 60  # of 108 MB freed


HEAPS = """
import ctypes, re, sys, threading
import numpy as np
from engine.core.native_process import share_one_heap
if sys.argv[1] == "one":
    share_one_heap()
begin = threading.Barrier(8)
def work():
    begin.wait()
    kept = [np.ones(50_000, np.uint8) for _ in range(50)]
    begin.wait()
threads = [threading.Thread(target=work) for _ in range(8)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p
file = libc.fopen(sys.argv[2].encode(), b"w")
libc.malloc_info(0, ctypes.c_void_p(file))
libc.fclose(ctypes.c_void_p(file))
print(len(re.findall("<heap nr", open(sys.argv[2]).read())))
"""


def heaps_of_eight_threads(how, path):
    ran = subprocess.run([sys.executable, "-c", HEAPS, how, str(path)], capture_output=True, text=True, check=True)
    return int(ran.stdout)


def test_threads_share_one_heap_where_they_are_told_to(tmp_path):
    assert heaps_of_eight_threads("one", tmp_path / "one.xml") == 1
    assert heaps_of_eight_threads("their own", tmp_path / "own.xml") > 1
