"""Results of a fit whose posterior is known exactly: linear predictions, normal prior and noise.

The layout is that of `polar_bayes.inference.result.assemble`. Readings are drawn from the prior
predictive, so every calibration check must pass at its stated rate.
"""

import json

import numpy as np
import xarray as xr
from scipy import stats

import polar_bayes as pb

PRIOR = {
    "roughness": (0.2, 0.05),
    "subsurface_fraction": (0.5, 0.15),
    "absorption": (0.4, 0.1),
    "refractive_index": (1.45, 0.08),
    "exposure": (1.0, 0.2),
}
SPECTRAL = ("absorption", "refractive_index")
SCALE = {"dop": 0.01, "q": 0.01, "intensity": 0.02}
FULL_SCALE = 1.0
SMALL = {"wavelengths": (), "views": 12, "draws": 150, "variables": ("dop",)}
"""A layout that is quick to summarize."""


def make_result(
    *,
    method="nuts",
    wavelengths=(450.0, 550.0, 650.0),
    views=40,
    chains=4,
    draws=250,
    variables=("dop", "intensity"),
    azimuths=(180.0,),
    materials=(),
    masked=(),
    limit=90.0,
    discrepancy=False,
    name="leaf",
    noise=1.0,
    seed=0,
):
    """A result tree; `noise` scales the readings' scatter against the one that the fit assumes."""
    rng = np.random.default_rng(seed)
    axes = {"material": materials, "wavelength": wavelengths}
    coords = {dim: np.asarray(labels) for dim, labels in axes.items() if len(labels)}
    lead = {dim: len(labels) for dim, labels in coords.items()}
    zenith = np.linspace(2.0, 85.0, views)
    valid = np.broadcast_to(
        (zenith <= limit) & ~np.isin(np.arange(views), masked), (*lead.values(), views)
    )
    names, location, width = _parameters(lead)
    design, offset = _design(variables, lead, names, zenith)
    truth = location + width * rng.standard_normal(len(location))
    observed, saturated = _observe(design, offset, truth, valid, noise, rng)

    mean, factor = _posterior(design, offset, observed, valid & ~saturated, location, width)
    grid = (1, 1) if method == "point" else (chains, draws)
    steps = rng.standard_normal((grid[0] * grid[1], len(mean))) @ factor.T
    theta = mean + steps * (method != "point")
    before = location + width * rng.standard_normal((500, len(location)))
    posterior, prior = _label(theta, names, lead, grid), _label(before, names, lead, (1, 500))
    if discrepancy:
        dims = ("chain", "draw", "discrepancy_weights_0")
        posterior["discrepancy_weights"] = (dims, rng.standard_normal((*grid, 4)))
        prior["discrepancy_weights"] = (dims, rng.standard_normal((1, 500, 4)))

    groups = {
        "posterior": posterior,
        "prior": prior,
        "sample_stats": _stats(method, grid, rng),
        "log_prior": _log_prior(theta, names, location, width, grid),
        "observed_data": {name: ((*lead, "view"), values) for name, values in observed.items()},
        **_predict(design, offset, theta, observed, valid, grid, lead, rng),
    }
    groups = {group: xr.Dataset(content, coords) for group, content in groups.items()}
    groups["constant_data"] = _constants(
        zenith, azimuths, valid, saturated, _label(truth[None], names, lead, (1, 1)), coords
    )
    if "intensity" in observed:
        groups["observed_data"]["intensity"].attrs["saturation_level"] = FULL_SCALE
    if discrepancy:
        narrow = _label(mean + 0.4 * (theta - mean), names, lead, grid)
        groups["without_discrepancy"] = xr.Dataset(narrow, coords)
    tree = xr.DataTree.from_dict(groups)
    provenance = _provenance(method, variables, limit, name, seed)
    provenance["settings"] = {"chains": chains, "draws": draws}
    provenance["counts"] = {
        "views": int(valid.size),
        "masked": int(len(masked) * valid.size // views),
        "saturated": int(saturated.sum()),
        "used": int(valid.sum()),
        "at_margin": dict.fromkeys(variables, 0),
    }
    if method == "point":
        provenance["standard_errors"] = {
            parameter: [
                None if parameter == "exposure" else float(sd)
                for (owner, _), sd in zip(names, width, strict=True)
                if owner == parameter
            ]
            for parameter in PRIOR
        }
    provenance["prior_probability"] = {
        parameter: np.ravel(
            stats.norm.cdf(np.median(values, axis=(0, 1)), *PRIOR[parameter])
        ).tolist()
        for parameter, (_, values) in _label(theta, names, lead, grid).items()
    }
    tree.attrs["polar_bayes"] = json.dumps(provenance)
    return tree


def pool(tree, *parameters, spread=0.05, seed=0):
    """Add a population to parameters of a tree with materials, in place."""
    rng = np.random.default_rng(seed)
    for group in ("posterior", "prior"):
        dataset = tree[group].to_dataset()
        for parameter in parameters:
            center = dataset[parameter].mean("material")
            dataset[f"{parameter}_location"] = center
            dims = ("chain", "draw")
            width = spread * np.exp(0.3 * rng.standard_normal([dataset.sizes[d] for d in dims]))
            dataset[f"{parameter}_spread"] = (dims, width)
        tree[group] = xr.DataTree(dataset)
    return tree


def edit_provenance(tree, **changes):
    """Replace entries of the provenance of a tree, in place."""
    tree.attrs["polar_bayes"] = json.dumps({**json.loads(tree.attrs["polar_bayes"]), **changes})
    return tree


def replace(tree, group, name, values):
    """Replace one variable of a group, in place, keeping its dims and attributes."""
    dataset = tree[group].to_dataset()
    dataset[name] = (dataset[name].dims, np.asarray(values), dataset[name].attrs)
    tree[group] = xr.DataTree(dataset)
    return tree


def moved(by, chains=slice(1), **asked):
    """A result some of whose chains are elsewhere in roughness."""
    result = make_result(**SMALL, **asked)
    draws = result["posterior"].to_dataset()["roughness"].to_numpy().copy()
    draws[chains] += by
    return replace(result, "posterior", "roughness", draws)


def worse(by, **asked):
    """A result that predicts its readings worse."""
    result = make_result(**SMALL | asked)
    density = result["log_likelihood"].to_dataset()["dop"]
    return replace(result, "log_likelihood", "dop", density - by * (1 + density["view"] % 3))


def with_law(**asked):
    """A result whose index follows Cauchy's law, with the coefficients of every draw."""
    result = make_result(**{"views": 6, "draws": 60, "variables": ("dop",)} | asked)
    posterior, rng = result["posterior"].to_dataset(), np.random.default_rng(5)
    grid = (posterior.sizes["chain"], posterior.sizes["draw"])
    for name, center, sd in (("cauchy_a", 1.45, 0.01), ("cauchy_b", 0.005, 0.001)):
        posterior[name] = (("chain", "draw"), center + sd * rng.standard_normal(grid))
    index = posterior["cauchy_a"] + posterior["cauchy_b"] / (posterior["wavelength"] / 1e3) ** 2
    posterior["refractive_index"] = index.transpose("chain", "draw", "wavelength")
    result["posterior"] = xr.DataTree(posterior)
    scene = pb.Scene(surface=pb.SmoothSurface(), dispersion=pb.physics.Cauchy())
    return edit_provenance(result, scene="custom", scene_parts=repr(scene))


def _parameters(lead):
    """Name and place of every entry of the parameter vector, with prior means and widths."""
    names = [
        (parameter, place)
        for parameter in PRIOR
        for place in np.ndindex(*(lead[dim] for dim in _own_dims(parameter, lead)))
    ]
    location, width = np.asarray([PRIOR[parameter] for parameter, _ in names]).T
    return names, location, width


def _own_dims(parameter, lead):
    """The dims of one parameter: materials have all but the exposure, colors only two."""
    if parameter == "exposure":
        return []
    return [dim for dim in lead if dim != "wavelength" or parameter in SPECTRAL]


def _design(variables, lead, names, zenith):
    """Slopes (..., view, parameter) and offsets (..., view) of every variable."""
    angle = np.radians(zenith)
    polarization = {
        "roughness": -0.3 * np.sin(angle) ** 4,
        "subsurface_fraction": -0.5 * np.sin(angle) ** 2,
        "absorption": 0.02 * np.cos(angle),
        "refractive_index": 0.6 * np.sin(2 * angle),
    }
    brightness = {
        "exposure": 0.55 + 0.4 * np.exp(-(((zenith - 45.0) / 10.0) ** 2)),
        "absorption": -0.3 * np.cos(angle),
    }
    designs, offsets = {}, {}
    for variable in variables:
        slopes = brightness if variable == "intensity" else polarization
        matrix = np.zeros((*lead.values(), len(zenith), len(names)))
        for column, (parameter, place) in enumerate(names):
            if parameter in slopes:
                at = dict(zip(_own_dims(parameter, lead), place, strict=True))
                where = tuple(at.get(dim, slice(None)) for dim in lead)
                matrix[(*where, slice(None), column)] = slopes[parameter]
        designs[variable] = matrix
        offsets[variable] = np.zeros(matrix.shape[:-1])
        if variable != "intensity":
            center = matrix @ np.asarray([PRIOR[parameter][0] for parameter, _ in names])
            offsets[variable] = 0.25 + 0.35 * np.sin(angle) ** 2 - center
    return designs, offsets


def _observe(design, offset, truth, valid, noise, rng):
    observed, saturated = {}, np.zeros(valid.shape, bool)
    for variable, matrix in design.items():
        scatter = noise * SCALE[variable] * rng.standard_normal(valid.shape)
        reading = matrix @ truth + offset[variable] + scatter
        if variable == "intensity":
            saturated = (reading >= FULL_SCALE) & valid
            reading = np.minimum(reading, FULL_SCALE)
        observed[variable] = np.where(valid, reading, np.nan)
    return observed, saturated


def _predict(design, offset, theta, observed, valid, grid, lead, rng):
    dims = ("chain", "draw", *lead, "view")
    centers, predictive, density = {}, {}, {}
    for variable, matrix in design.items():
        center = np.einsum("...p,sp->s...", matrix, theta) + offset[variable]
        predicted = center + SCALE[variable] * rng.standard_normal(center.shape)
        if variable == "intensity":
            predicted = np.minimum(predicted, FULL_SCALE)
        z = (np.where(valid, observed[variable], 0.0) - center) / SCALE[variable]
        log_density = -0.5 * z**2 - np.log(SCALE[variable] * np.sqrt(2 * np.pi))
        shape = (*grid, *valid.shape)
        centers[variable] = (dims, center.reshape(shape))
        predictive[variable] = (dims, predicted.reshape(shape))
        density[variable] = (dims, np.where(valid, log_density, 0.0).reshape(shape))
    return {"noise_free": centers, "posterior_predictive": predictive, "log_likelihood": density}


def _posterior(design, offset, observed, used, location, width):
    precision = np.diag(width**-2.0)
    pull = precision @ location
    for variable, matrix in design.items():
        rows = matrix[used] / SCALE[variable]
        precision = precision + rows.T @ rows
        pull = pull + rows.T @ ((observed[variable] - offset[variable])[used] / SCALE[variable])
    covariance = np.linalg.inv(precision)
    return covariance @ pull, np.linalg.cholesky(covariance)


def _label(theta, names, lead, grid):
    labelled = {}
    for parameter in PRIOR:
        columns = [i for i, (owner, _) in enumerate(names) if owner == parameter]
        own = _own_dims(parameter, lead)
        values = theta[:, columns].reshape(*grid, *(lead[dim] for dim in own))
        labelled[parameter] = (("chain", "draw", *own), values)
    return labelled


def _log_prior(theta, names, location, width, grid):
    scores = -0.5 * ((theta - location) / width) ** 2
    owners = np.asarray([parameter for parameter, _ in names])
    return {
        parameter: (("chain", "draw"), scores[:, owners == parameter].sum(axis=1).reshape(grid))
        for parameter in PRIOR
    }


def _provenance(method, variables, limit, name, seed):
    provenance = {
        "method": method,
        "model": "per_material",
        "scene": "paper",
        "scene_parts": "Scene(surface=SmoothSurface())",
        "priors": {n: f"Normal(loc={m:g}, scale={s:g})" for n, (m, s) in PRIOR.items()},
        "links": {variable: "NormalLink()" for variable in variables},
        "swapped": ["prior of refractive_index"],
        "largest_view_zenith": limit,
        "seed": seed,
        "precision": "double",
        "chain_method": "threads",
        "versions": {"polar_bayes": "0.1.0"},
        "machine": {"processor": "x86_64", "python": "3.12"},
        "timings": {"modes": 1.5, "draws": 2.25},
        "problems": [],
        "alternatives": [],
        "capture": {"name": name, "setup": "paper"},
    }
    if method != "point":
        provenance["modes"] = {"starts": 16, "failures": 0, "weights": [1.0]}
    return provenance


def _stats(method, grid, rng):
    dims = ("chain", "draw")
    if method == "point":
        return {"loss": (dims, np.zeros(grid))}
    if method == "laplace":
        weight = 1e-3 * rng.standard_normal(grid)
        return {"lp": (dims, rng.standard_normal(grid)), "log_weight": (dims, weight)}
    return {
        "diverging": (dims, np.zeros(grid, bool)),
        "acceptance_rate": (dims, np.full(grid, 0.9)),
        "n_steps": (dims, np.full(grid, 7)),
        "energy": (dims, rng.standard_normal(grid)),
        "lp": (dims, rng.standard_normal(grid)),
        "step_size": (dims, np.full(grid, 0.5)),
        "reached_max_treedepth": (dims, np.zeros(grid, bool)),
    }


def _constants(zenith, azimuths, valid, saturated, truth, coords):
    order = (*coords, "view")
    constants = {
        "view_zenith": ("view", zenith, {"units": "degree"}),
        "view_azimuth": ("view", np.resize(azimuths, len(zenith))),
        "light_zenith": ("view", np.full(len(zenith), 45.0)),
        "light_azimuth": ("view", np.zeros(len(zenith))),
        "valid": (order, valid.astype("int8")),
        "saturated": (order, saturated.astype("int8")),
    }
    for name, (dims, values) in truth.items():
        if name != "exposure":
            constants[f"true_{name}"] = (dims[2:], values[0, 0])
    return xr.Dataset(constants, coords)
