"""New draws of a distribution that is known only through weighted, repeated or correlated draws."""

import numpy as np
from scipy.special import ndtr, ndtri

from pre_core.arrays import FloatArray


def copula_draws(draws: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Return independent draws (count, n) with the marginals and rank correlations of `draws`.

    `draws` are (k, n). The new ones have a Gaussian copula, so that none is repeated. A coordinate
    that is the same in all draws stays so.
    """
    new = np.repeat(draws[:1], count, axis=0)
    varying = np.flatnonzero(np.ptp(draws, axis=0) > 0.0)
    ranks = draws[:, varying].argsort(axis=0, kind="stable").argsort(axis=0)
    scores = ndtri((ranks + 0.5) / draws.shape[0])
    variance, directions = np.linalg.eigh(np.atleast_2d(np.corrcoef(scores.T)))
    root = directions * np.sqrt(np.maximum(variance, 0.0))
    # A product with the symmetric root does not depend on the signs of the directions.
    normal = rng.standard_normal((count, varying.size)) @ (root @ directions.T)
    for place, probability in zip(varying, ndtr(normal).T, strict=True):
        new[:, place] = np.quantile(draws[:, place], probability)
    return new
