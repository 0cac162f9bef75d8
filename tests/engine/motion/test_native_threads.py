"""A pipeline keeps native calls in the thread that makes them: see engine/core/native_process.py."""

from collections.abc import Iterator

import cv2
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from tests.support.motion.pipelines import new_pipeline


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Give BLAS and OpenCV two threads, against what holds in the rest of the test process."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    with threadpool_limits(limits=2):
        yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("two_threads")
def test_a_new_pipeline_limits_blas_and_opencv_to_one_thread():
    assert [pool["num_threads"] for pool in threadpool_info()].count(2) > 0
    new_pipeline()
    assert {pool["num_threads"] for pool in threadpool_info()} == {1}
    assert cv2.getNumThreads() == 1
