r"""Smoothness prior of neighboring pixels: an intrinsic Gaussian Markov random field.

With $m_i, \sigma_i$ the posterior of one parameter in pixel i, the posterior of all pixels under
the further prior $\exp(-\sum_{i \sim j} (x_i - x_j)^2 / 2 \tau^2)$ has the precision and mean

$$ Q = \mathrm{diag}(\sigma_i^{-2}) + \tau^{-2} L, \qquad Q^{-1} \mathrm{diag}(\sigma_i^{-2})\, m $$

with L the graph Laplacian of the four neighbors. Other parameters are integrated out pixel by
pixel, which is exact as long as they have no smoothness of their own.

Source:
    Besag & Kooperberg (1995), Biometrika 82(4), 733-746 (intrinsic autoregressions); Papandreou &
    Yuille (2010), NIPS 23 (draws by perturbation); Siden, Lindgren, Bolin & Villani (2018), J.
    Comput. Graph. Stat. 27(4), 798-808 (variances by Rao-Blackwellized Monte Carlo).
"""

import math

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.inference.batching import IMAGE, Status
from polar_bayes.maps.lazy import checked_status, ensure_loaded


def smooth(maps: xr.Dataset, name: str, neighbor_sd: float, *, seed: int = 0) -> xr.Dataset:
    """Smooth a parameter of a map by a prior on the differences of neighboring pixels.

    The prior multiplies those of the pixels: the difference of each pixel from its neighbors above,
    below, left and right is normal with standard deviation `neighbor_sd`, wherever both have an
    answer. It is a statement about the object, not about the readings: edges are smoothed as well.
    The posterior of each pixel is taken as normal; what pixels share counts once.

    Args:
        maps: Of `polar_bayes.fit_pixels`, or opened from a store; read into memory.
        name: A parameter with one value in each pixel.
        neighbor_sd: Above 0, in the unit of the parameter.
        seed: Of the draws by which standard deviations are found.

    Returns:
        `<name>` and `<name>_sd`, (y, x); NaN where a pixel has no answer. Neighbors depend on each
        other, so that the mean of a region must not be taken from these.

    Raises:
        FitError: No such parameter, it has several values in a pixel, no pixel has an answer, or
            `neighbor_sd` is not above 0.
    """
    where = f"smooth: {name}"
    if name not in maps or f"{name}_sd" not in maps or set(maps[name].dims) != set(IMAGE):
        hint = "give a parameter of the map that has one value in each pixel"
        raise FitError("no such map", where=where, hint=hint)
    if not 0.0 < neighbor_sd < math.inf:
        hint = f"give a number above 0 in the unit of {name}"
        raise FitError(f"neighbor_sd is {neighbor_sd}", where=where, hint=hint)
    maps = ensure_loaded(maps).transpose(..., *IMAGE)
    is_known = (checked_status(maps) == Status.GOOD).to_numpy()
    if not is_known.any():
        raise FitError("no pixel has an answer", where=where, hint="see pb.maps.count_pixels")
    mean, variance = (maps[each].to_numpy()[is_known] for each in (name, f"{name}_sd"))
    variance = variance.astype(float) ** 2
    slopes = np.zeros((0, mean.size))
    if f"{name}_slope" in maps:
        slopes = maps[f"{name}_slope"].to_numpy()[:, is_known].astype(float)
    # Given what all pixels share, they are independent.
    precision = 1.0 / np.maximum(variance - np.sum(slopes**2, axis=0), 1e-6 * variance)
    differences = _differences(is_known) / neighbor_sd
    information = scipy.sparse.diags(precision) + differences.T @ differences
    solve = scipy.sparse.linalg.splu(information.tocsc()).solve
    gains = np.reshape([solve(precision * slope) for slope in slopes], slopes.shape)
    # How far neighbors are apart also says something about the scores of what is shared.
    residuals = precision * (slopes - gains)
    covariance = np.linalg.inv(np.eye(len(slopes)) + residuals @ slopes.T)
    scores = -covariance @ (residuals @ mean)
    smoothed = solve(precision * mean) + scores @ gains
    random, diagonal, draws = np.random.default_rng(seed), information.diagonal(), 256
    # A pixel's variance given the others is known; only that of its conditional mean is drawn, with
    # an error of a few percent at most.
    squares = np.zeros(precision.size)
    for _ in range(draws):
        perturbed = np.sqrt(precision) * random.normal(size=precision.size)
        perturbed += differences.T @ random.normal(size=differences.shape[0])
        given_others = solve(perturbed) - perturbed / diagonal
        squares += given_others**2
    own = 1.0 / diagonal + squares / draws
    common = np.einsum("kp,kl,lp->p", gains, covariance, gains)
    answer = xr.Dataset()
    for ending, x in (("", smoothed), ("_sd", np.sqrt(own + common))):
        whole = np.full(is_known.shape, np.nan)
        whole[is_known] = x
        answer[f"{name}{ending}"] = (IMAGE, whole, maps[f"{name}{ending}"].attrs)
    coords = {dim: maps[dim] for dim in IMAGE if dim in maps.coords}
    return answer.assign_coords(coords).assign_attrs(neighbor_sd=neighbor_sd)


def _differences(is_known: np.ndarray) -> scipy.sparse.csr_array:
    """Return the difference matrix of neighbors that both have an answer, (pair, pixel)."""
    number = np.where(is_known, np.cumsum(is_known).reshape(is_known.shape) - 1, -1)
    neighbors = (number[1:], number[:-1]), (number[:, 1:], number[:, :-1])
    pairs = np.concatenate([np.stack(both, axis=-1).reshape(-1, 2) for both in neighbors])
    pairs = pairs[(pairs >= 0).all(axis=1)]
    rows, signs = np.repeat(np.arange(len(pairs)), 2), np.tile([1.0, -1.0], len(pairs))
    shape = len(pairs), int(is_known.sum())
    return scipy.sparse.csr_array((signs, (rows, pairs.ravel())), shape=shape)
