"""Evaluation runs: data sets, trials, scores, marks and ablations."""
