"""Accuracy of the breathing monitor: trials, scores, tables and pictures."""
