"""Camera calibration: the calibration file, sensor quantisation.

Foreign formats and the procedures that make a calibration.
"""
