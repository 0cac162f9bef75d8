"""Least squares of a few terms; the compiled form solves well-conditioned ones, numpy's the rest."""

import numpy as np

from engine.core.compiled import kernels
from engine.core.frames import FloatArray


def least_squares(terms: FloatArray, values: FloatArray) -> FloatArray:
    """Return the weights of some terms, shape (k, n), whose sum is closest to values, shape (n,); shape (k,).

    Of several answers the shortest. NaN raises `numpy.linalg.LinAlgError` or gives NaN, as numpy's does.
    """
    compiled = kernels()
    if compiled is not None:
        weights = np.empty(len(terms))
        if compiled.least_squares(np.ascontiguousarray(terms), np.ascontiguousarray(values), weights):
            return weights
    return np.asarray(np.linalg.lstsq(terms.T, values, rcond=None)[0])
