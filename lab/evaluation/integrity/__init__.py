"""Evaluation on falsified recordings: whether what is reported as measured is the patient's motion."""
