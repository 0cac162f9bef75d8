"""Make a phantom, measure it, compare with its truth: python phantom_and_truth.py FOLDER."""

import sys

import tidegate

folder = tidegate.make_phantom(sys.argv[1], "irregular", seconds=30.0, seed=5)
cells = tidegate.PipelineSettings(cell_px=10)  # the truth's cells
motion = tidegate.measure_recording(folder / "recording.oni", settings=cells)
score = tidegate.score(motion, tidegate.read_truth(folder / "truth.npz"))
print(f"mean error: cells {score.regions_mm:.3f} mm, abdomen {score.abdomen_mm:.3f} mm, {score.frames} frames")
