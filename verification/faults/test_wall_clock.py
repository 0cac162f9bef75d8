"""The wall clock of a process's own jumps when it is reported; what counts by the monotonic clock does not notice."""

import os
import subprocess
import sys
import time

import pytest

from verification.faults.wall_clock import WallClock

pytestmark = pytest.mark.waiting

ASKED = """
import sys, threading, time
for line in sys.stdin:
    began = time.monotonic()
    threading.Event().wait(0.05)
    time.sleep(0.05)
    print(time.time(), time.monotonic(), time.monotonic() - began, flush=True)
"""


@pytest.fixture
def clock(tmp_path):
    return WallClock(tmp_path)


@pytest.fixture
def asked(clock):
    process = subprocess.Popen(
        [sys.executable, "-c", ASKED],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **clock.environment},
    )

    def ask() -> list[float]:
        process.stdin.write("now\n")
        process.stdin.flush()
        return [float(word) for word in process.stdout.readline().split()]

    with process:
        yield ask
        process.kill()


@pytest.mark.parametrize("hours", [1, -1, 0])
def test_the_time_of_day_jumps_and_the_monotonic_clock_and_its_waits_do_not(clock, asked, hours):
    first = asked()
    assert first[0] == pytest.approx(time.time(), abs=5.0)
    clock.set(hours * 3600.0)
    second = asked()
    assert second[0] - time.time() == pytest.approx(hours * 3600.0, abs=5.0)
    assert second[1] == pytest.approx(time.monotonic(), abs=5.0)
    for answer in (first, second):
        assert 0.1 <= answer[2] < 5.0


WAITS = """
#include <pthread.h>
#include <stdio.h>
#include <time.h>
int main(void) {
    pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
    pthread_cond_t condition = PTHREAD_COND_INITIALIZER;
    struct timespec due;
    clock_gettime(CLOCK_REALTIME, &due);
    due.tv_sec += 1800;
    pthread_mutex_lock(&mutex);
    puts("waits");
    fflush(stdout);
    printf("%d\\n", pthread_cond_timedwait(&condition, &mutex, &due));
    return 0;
}
"""


def test_what_waits_for_a_time_of_day_is_woken_when_the_clock_jumps_beyond_it(clock, tmp_path):
    source = tmp_path / "waits.c"
    source.write_text(WAITS)
    subprocess.run(["gcc", str(source), "-o", str(tmp_path / "waits"), "-pthread"], check=True)
    environment = {**os.environ, **clock.environment}
    with subprocess.Popen([tmp_path / "waits"], stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout.readline() == "waits\n"
        clock.set(3600.0)
        out, _ = process.communicate(timeout=20.0)
    assert out == "110\n"  # ETIMEDOUT
