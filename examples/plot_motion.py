"""Measure a recording and plot thorax and abdomen: python plot_motion.py recording.oni motion.png."""

import sys

import tidegate

recording, picture = sys.argv[1:]
motion = tidegate.measure_recording(recording)
print(f"{motion.is_measured.sum()} of {len(motion.state)} frames measured")
tidegate.plot(motion, picture)
