"""Measure one recording under several settings, side by side: python sweep.py recording.oni."""

import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import tidegate

if __name__ == "__main__":
    rows = (140, 175, 210)
    choices = [tidegate.PipelineSettings(thorax_rows=number) for number in rows]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        runs = [pool.submit(partial(tidegate.measure_recording, sys.argv[1], settings=one)) for one in choices]
        for number, run in zip(rows, runs, strict=True):
            thorax = run.result().signal("thorax").value_mm
            print(f"thorax above row {number}: {thorax.max() - thorax.min():.2f} mm")
