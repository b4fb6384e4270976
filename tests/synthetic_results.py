"""Results of a fit whose posterior is known exactly: linear predictions, normal prior and noise.

The layout is that of `polar_bayes.inference.result.assemble`. Readings are drawn from the prior
predictive, so every calibration check must pass at its stated rate.
"""

import json

import numpy as np
import xarray as xr

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
    zenith = np.linspace(2.0, 85.0, views)
    valid_view = (zenith <= limit) & ~np.isin(np.arange(views), masked)
    axes = {"material": materials, "wavelength": wavelengths}
    lead = {dim: len(labels) for dim, labels in axes.items() if labels}
    names, location, width = _parameters(lead)
    design, offset = _design(variables, lead, names, zenith)
    shape = (*lead.values(), views)
    valid = np.broadcast_to(valid_view, shape)

    truth = location + width * rng.standard_normal(len(location))
    observed, saturated = {}, np.zeros(shape, bool)
    for variable in variables:
        signal = design[variable] @ truth + offset[variable]
        reading = signal + noise * SCALE[variable] * rng.standard_normal(shape)
        if variable == "intensity":
            saturated = (reading >= FULL_SCALE) & valid
            reading = np.minimum(reading, FULL_SCALE)
        observed[variable] = np.where(valid, reading, np.nan)

    draw = _posterior(design, offset, observed, valid & ~saturated, location, width)
    count = 1 if method == "point" else chains * draws
    mean, factor = draw
    theta = mean + (count > 1) * rng.standard_normal((count, len(mean))) @ factor.T
    grid = (1, 1) if method == "point" else (chains, draws)

    dims = ("chain", "draw", *lead, "view")
    centers, predictive, density = {}, {}, {}
    for variable in variables:
        center = np.einsum("...p,sp->s...", design[variable], theta) + offset[variable]
        scatter = SCALE[variable] * rng.standard_normal(center.shape)
        predicted = center + scatter
        if variable == "intensity":
            predicted = np.minimum(predicted, FULL_SCALE)
        z = (np.where(valid, observed[variable], 0.0) - center) / SCALE[variable]
        log_density = -0.5 * z**2 - np.log(SCALE[variable] * np.sqrt(2 * np.pi))
        density[variable] = (dims, np.where(valid, log_density, 0.0).reshape(*grid, *shape))
        centers[variable] = (dims, center.reshape(*grid, *shape))
        predictive[variable] = (dims, predicted.reshape(*grid, *shape))

    coords = {dim: np.asarray(labels) for dim, labels in axes.items() if labels}
    prior_theta = location + width * rng.standard_normal((500, len(location)))
    posterior = _label(theta, names, lead, grid)
    prior = _label(prior_theta, names, lead, (1, 500))
    if discrepancy:
        weights = rng.standard_normal((*grid, 4))
        dim = "discrepancy_weights_0"
        posterior["discrepancy_weights"] = (("chain", "draw", dim), weights)
        prior["discrepancy_weights"] = (("chain", "draw", dim), rng.standard_normal((1, 500, 4)))
    log_prior = {
        parameter: (
            ("chain", "draw"),
            (-0.5 * ((theta[:, at] - location[at]) / width[at]) ** 2).sum(-1).reshape(grid),
        )
        for parameter in PRIOR
        for at in [[i for i, (n, _) in enumerate(names) if n == parameter]]
        if at
    }
    groups = {
        "posterior": xr.Dataset(posterior, coords),
        "prior": xr.Dataset(prior, coords),
        "sample_stats": xr.Dataset(_stats(method, grid, rng)),
        "posterior_predictive": xr.Dataset(predictive, coords),
        "noise_free": xr.Dataset(centers, coords),
        "log_likelihood": xr.Dataset(density, coords),
        "log_prior": xr.Dataset(log_prior),
        "observed_data": xr.Dataset(
            {name: (dims[2:], reading) for name, reading in observed.items()}, coords
        ),
        "constant_data": _constants(zenith, azimuths, valid, saturated, truth, names, lead, coords),
    }
    if "intensity" in observed:
        groups["observed_data"]["intensity"].attrs["saturation_level"] = FULL_SCALE
    if discrepancy:
        narrow = mean + 0.4 * (theta - mean)
        groups["without_discrepancy"] = xr.Dataset(_label(narrow, names, lead, grid), coords)
    tree = xr.DataTree.from_dict(groups)
    errors = {
        parameter: [
            None if parameter == "exposure" else float(width[i])
            for i, (n, _) in enumerate(names)
            if n == parameter
        ]
        for parameter in dict.fromkeys(n for n, _ in names)
    }
    provenance = {
        "method": method,
        "settings": {"chains": chains, "draws": draws},
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
        "counts": {
            "views": int(valid.size),
            "masked": int(len(masked) * valid.size // views),
            "saturated": int(saturated.sum()),
            "used": int(valid.sum()),
            "at_margin": dict.fromkeys(variables, 0),
        },
        "problems": [],
        "capture": {"name": name, "setup": "paper"},
    }
    if method == "point":
        provenance["standard_errors"] = errors
    else:
        provenance["modes"] = {"starts": 16, "failures": 0, "weights": [1.0]}
    tree.attrs["polar_bayes"] = json.dumps(provenance)
    return tree


def edit_provenance(tree, **changes):
    """Replace entries of the provenance of a tree, in place."""
    tree.attrs["polar_bayes"] = json.dumps({**json.loads(tree.attrs["polar_bayes"]), **changes})
    return tree


def replace(tree, group, name, values):
    """Replace one variable of a group, in place, keeping its dims."""
    dataset = tree[group].to_dataset()
    dataset[name] = (dataset[name].dims, np.asarray(values))
    tree[group] = xr.DataTree(dataset)
    return tree


def _parameters(lead):
    """Name and place of every entry of the parameter vector, with prior means and widths."""
    names, location, width = [], [], []
    for parameter, (mean, sd) in PRIOR.items():
        dims = {d: n for d, n in lead.items() if parameter != "exposure" and d != "wavelength"} | {
            d: n for d, n in lead.items() if d == "wavelength" and parameter in SPECTRAL
        }
        ordered = [dims[d] for d in lead if d in dims]
        for place in np.ndindex(*ordered):
            names.append((parameter, place))
            location.append(mean)
            width.append(sd)
    return names, np.asarray(location), np.asarray(width)


def _design(variables, lead, names, zenith):
    """Slopes (..., view, parameter) and offsets (..., view) of every variable."""
    angle = np.radians(zenith)
    slope = {
        "dop": {
            "roughness": -0.3 * np.sin(angle) ** 4,
            "subsurface_fraction": -0.5 * np.sin(angle) ** 2,
            "absorption": 0.02 * np.cos(angle),
            "refractive_index": 0.6 * np.sin(2 * angle),
        },
        "intensity": {
            "exposure": 0.55 + 0.4 * np.exp(-(((zenith - 45.0) / 10.0) ** 2)),
            "absorption": -0.3 * np.cos(angle),
        },
    }
    slope["q"] = slope["dop"]
    designs, offsets = {}, {}
    shape = (*lead.values(), len(zenith))
    dims = list(lead)
    for variable in variables:
        matrix = np.zeros((*shape, len(names)))
        shift = np.zeros(shape) + (
            0.25 + 0.35 * np.sin(angle) ** 2 if variable != "intensity" else 0.0
        )
        for column, (parameter, place) in enumerate(names):
            if parameter not in slope[variable]:
                continue
            own = [d for d in dims if parameter != "exposure" and d != "wavelength"]
            own += [d for d in dims if d == "wavelength" and parameter in SPECTRAL]
            own = [d for d in dims if d in own]
            where = tuple(place[own.index(d)] if d in own else slice(None) for d in dims)
            matrix[(*where, slice(None), column)] = slope[variable][parameter]
            if variable != "intensity":
                shift[where] -= slope[variable][parameter] * PRIOR[parameter][0]
        designs[variable], offsets[variable] = matrix, shift
    return designs, offsets


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
    for parameter in dict.fromkeys(n for n, _ in names):
        columns = [i for i, (n, _) in enumerate(names) if n == parameter]
        own = [d for d in lead if parameter != "exposure" and d != "wavelength"]
        own += [d for d in lead if d == "wavelength" and parameter in SPECTRAL]
        own = [d for d in lead if d in own]
        values = theta[:, columns].reshape(*grid, *(lead[d] for d in own))
        labelled[parameter] = (("chain", "draw", *own), values)
    return labelled


def _stats(method, grid, rng):
    dims = ("chain", "draw")
    if method == "point":
        return {"loss": (dims, np.zeros(grid))}
    if method == "laplace":
        return {"lp": (dims, rng.standard_normal(grid))}
    return {
        "diverging": (dims, np.zeros(grid, bool)),
        "acceptance_rate": (dims, np.full(grid, 0.9)),
        "n_steps": (dims, np.full(grid, 7)),
        "energy": (dims, rng.standard_normal(grid)),
        "lp": (dims, rng.standard_normal(grid)),
        "step_size": (dims, np.full(grid, 0.5)),
        "reached_max_treedepth": (dims, np.zeros(grid, bool)),
    }


def _constants(zenith, azimuths, valid, saturated, truth, names, lead, coords):
    order = (*lead, "view")
    constants = {
        "view_zenith": ("view", zenith, {"units": "degree"}),
        "view_azimuth": ("view", np.resize(azimuths, len(zenith))),
        "light_zenith": ("view", np.full(len(zenith), 45.0)),
        "light_azimuth": ("view", np.zeros(len(zenith))),
        "valid": (order, valid.astype("int8")),
        "saturated": (order, saturated.astype("int8")),
    }
    labelled = _label(truth[None], names, lead, (1, 1))
    for name, (dims, values) in labelled.items():
        if name != "exposure":
            constants[f"true_{name}"] = (dims[2:], values[0, 0])
    return xr.Dataset(constants, coords)
