"""A map that one can point at: one HTML page with its numbers, its readings and its own scripts.

The page holds numbers as integers of 16 bits between the smallest and the largest of each map, so
that it stays small enough to open; what a script shows of them has five digits.
"""

import dataclasses
import html
import importlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, override

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from numpyro import handlers

from polar_bayes.capture.plausibility import azimuth_difference
from polar_bayes.capture.schema import validate
from polar_bayes.diagnostics.coverage import INTERVALS, map_scalars
from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.errors import CaptureError, FitError, SceneError, one_line
from polar_bayes.inference.batching import IMAGE, batched
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.program import noise_free
from polar_bayes.maps.fit_map import MapPlan, mask_missing, plan_map
from polar_bayes.maps.lazy import checked_status, ensure_loaded, shared_parameters
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.observation.data import ANGLES, READINGS, Observations
from polar_bayes.paths import atomic_write
from polar_bayes.reporting import page, style
from polar_bayes.reporting.maps import (
    NO_ANSWER,
    TRUST,
    flag_indices,
    flag_meanings,
    map_name,
    parameter_titles,
    shown_wavelengths,
)
from polar_bayes.reporting.style import BLUE, VERMILLION
from polar_bayes.scenes.scene_file import arguments_of

MOST_PIXELS = 1_000_000
"""Of a map with more, pixels are binned."""

MOST_READINGS = 4_000_000
"""Readings, fitted values and directions of a page, which take 11 MB; of further pixels there are
none."""

IN_PLANE = 1.0
"""Views so far from the plane of the light belong to one curve. Unit degree."""

SIDE, AROUND = 640, 70
"""Width of the map, and height of what is above and below it. Unit pixel."""

ANY_WIDTH = "largest 95% width that is shown: any"

ASKED = ("model", "method", "scene", "priors", "links", "largest_view_zenith")
"""What maps were asked for, as far as it decides their predictions."""

CODES = 65_535
"""Largest integer of a map on the page; zero stands for no number."""


@dataclasses.dataclass(frozen=True, repr=False)
class Explorer:
    """The page of a map that one can point at, which a notebook shows.

    Args:
        html: The page, which refers to no other file.
    """

    html: str

    @override
    def __repr__(self) -> str:
        return f"Explorer of {len(self.html) / 1e6:.1f} MB: explorer.save('explore.html')"

    def _repr_html_(self) -> str:
        style = "width: 100%; height: 52rem; border: 0"
        return f'<iframe title="map" style="{style}" srcdoc="{html.escape(self.html)}"></iframe>'

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, which a browser opens without a network.

        Args:
            path: The file, such as "explore.html". An older page of this kind is replaced.

        Returns:
            The path of the page.

        Raises:
            OutputError: The file cannot be written, or is no page of this kind.
        """
        with atomic_write(path, page.is_page) as unfinished:
            unfinished.write_text(self.html, encoding="utf-8")
        return Path(path)


def explore(maps: xr.Dataset, capture: xr.Dataset | None = None) -> Explorer:
    """A map that one can point at, as one page for a notebook or a browser.

    Pointing at a pixel shows its parameters with their 95% intervals, its status and its Pareto k.
    A click shows its readings and the values that the model predicts at the posterior means. A
    slider sets the largest width of the interval that is shown. A map of more than a million pixels
    is binned, and of a large capture one in several pixels has its readings; the page says so.

    Args:
        maps: Of `polar_bayes.fit_pixels`, or opened from a store.
        capture: The image of which they were made, for the readings; without it a click shows
            nothing.

    Returns:
        The page. Parameters that have several wavelengths are shown at the first, the middle and
        the last.

    Raises:
        FitError: It holds no maps, or Bokeh is not installed.
        CaptureError: The capture is not the one of the maps.
    """
    if not isinstance(maps, xr.Dataset) or any(name not in maps for name in TRUST):
        raise FitError("it holds no maps", where="explore", hint="give what fit_pixels returns")
    if not page.has_explorer():
        what, hint = "the library of this page, Bokeh, is not installed", page.INSTALL
        raise FitError(what, where="explore", hint=hint)
    maps = ensure_loaded(maps)
    titles = shown_parameters(maps)
    about, arrays = map_numbers(maps, titles)
    size = " x ".join(f"{maps.sizes[dim]:,}" for dim in IMAGE)
    sentences = [
        f"{size} pixels. Point at one to see its parameters with their 95% intervals, its status "
        "and its Pareto k. Gray pixels have no answer, or one wider than the slider allows."
    ]
    if about["bin"] > 1:
        sentences.append(
            f"The map is binned, because it has more than {MOST_PIXELS:,} pixels: a bin of "
            f"{about['bin']} x {about['bin']} shows the means of its pixels' means, of the ends of "
            "their intervals and of their k, and the status that most of them have."
        )
    if len(titles) < len(map_scalars(maps)):
        places = ", ".join(f"{each:g}" for each in shown_wavelengths(maps))
        sentences.append(f"Of {maps.sizes['wavelength']} wavelengths, {places} nm are shown.")
    if capture is None:
        about |= {"panels": []}
        sentences.append("The page was made without the capture, so a click shows no readings.")
    else:
        found, more, said = map_readings(maps, capture)
        about, arrays, sentences = {**about, **found}, {**arrays, **more}, [*sentences, *said]
    return Explorer(_page(map_name(maps, capture), sentences, about, arrays))


def shown_parameters(maps: xr.Dataset) -> dict[Scalar, str]:
    """Every parameter with its title, at the wavelengths that are shown."""
    titles = parameter_titles(map_scalars(maps))
    kept = _wavelength_places(maps)
    return {x: title for x, title in titles.items() if x.index.get("wavelength", kept[0]) in kept}


def _wavelength_places(values: xr.Dataset) -> list[int]:
    """Where the wavelengths are that are shown; one place where there are none."""
    if "wavelength" not in values.dims:
        return [0]
    return np.flatnonzero(np.isin(values["wavelength"], shown_wavelengths(values))).tolist()


# --- Numbers as integers --------------------------------------------------------------------------


def encode(values: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """Numbers as integers of 16 bits, flat, and how they are read back."""
    values = np.asarray(values, float).ravel()
    known = np.isfinite(values)
    low, high = (values[known].min(), values[known].max()) if known.any() else (0.0, 0.0)
    is_log = bool(low > 0.0 and high > 100.0 * low)
    values = np.where(known, values, low)
    if is_log:
        values, low, high = np.log(values), math.log(low), math.log(high)
    step = (high - low) / (CODES - 1) or 1.0
    codes = np.where(known, 1.0 + np.round((values - low) / step), 0.0).astype(np.uint16)
    return codes, {"low": float(low), "step": float(step), "is_log": is_log}


def map_numbers(
    maps: xr.Dataset, titles: Mapping[Scalar, str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Means, ends of intervals, status and Pareto k of every pixel or bin, and what they mean."""
    bin_size = math.ceil(math.sqrt(maps.sizes["y"] * maps.sizes["x"] / MOST_PIXELS))

    def binned(values: xr.DataArray) -> np.ndarray:
        values = values.transpose(*IMAGE).astype(np.float32)
        values = values.where(np.isfinite(values))
        if bin_size > 1:
            values = values.coarsen(y=bin_size, x=bin_size, boundary="pad").mean()
        return values.to_numpy()

    status = checked_status(maps)
    meanings = flag_meanings(status)
    index = flag_indices(status, meanings).reshape([maps.sizes[dim] for dim in IMAGE])
    most, at = np.full((1, 1), -1.0), np.zeros((1, 1), np.uint8)
    for i in range(len(meanings)):
        share = binned(xr.DataArray(index == i, dims=IMAGE))
        at, most = np.where(share > most, np.uint8(i), at), np.maximum(share, most)
    k, scale_of_k = encode(binned(maps["pareto_k"]))
    codes, scales, colors, widths, first = [], [], [], [], None
    for scalar in titles:
        ends = maps[f"{scalar.name}_quantile"].isel(scalar.index)
        mean = binned(maps[scalar.name].isel(scalar.index))
        low, high = (binned(ends.sel(quantile=level)) for level in INTERVALS[95])
        coded, read = zip(*map(encode, (mean, low, high)), strict=True)
        codes.append(list(coded))
        scales.append(read)
        colors.append(_quantiles(mean, [0.01, 0.99]))
        widths.append(_quantiles(high - low, np.linspace(0.0, 1.0, 101)))
        first = mean if first is None else first
    about = {
        "shape": at.shape,
        "bin": bin_size,
        "titles": list(titles.values()),
        "markup": [html.escape(title) for title in titles.values()],
        "statuses": list(meanings.values()),
        "scales": scales,
        "scale_of_k": scale_of_k,
        "colors": colors,
        "widths": widths,
        "any_width": ANY_WIDTH,
        "inks": [BLUE, VERMILLION],
    }
    return about, {"image": first, "codes": codes, "trust": [at.ravel(), k]}


def _quantiles(values: np.ndarray, levels: Sequence[float] | np.ndarray) -> list[float]:
    known = values[np.isfinite(values)]
    return np.quantile(known, levels).tolist() if known.size else [0.0] * len(levels)


# --- Readings -------------------------------------------------------------------------------------


def map_readings(
    maps: xr.Dataset, capture: xr.Dataset
) -> tuple[dict[str, Any], dict[str, Any], list[str]]:
    """Readings of one in several pixels with the values predicted there, and sentences on them."""
    for dim in IMAGE:
        if capture.sizes.get(dim) != maps.sizes[dim]:
            has = f"{capture.sizes.get(dim, 0):,} pixels"
            what = f"its axis {dim} has {has}, that of the maps {maps.sizes[dim]:,}"
            hint = "give the capture of which the maps were made"
            raise CaptureError(what, where="explore: capture", hint=hint)
    plan, said = None, []
    asked: dict[str, Any] = dict.fromkeys(ASKED)
    try:
        asked |= {"model": "per_material", **arguments_of(maps), "method": None}
        shared = tuple(shared_parameters(maps).index)
        plan = plan_map(capture, **asked, seed=0, precision="double", shared=shared)
        if missing := [n for n in plan.engine.program.supports if n not in {*maps, *shared}]:
            what, hint = f"the maps do not hold {', '.join(missing)}", "fit one pixel by itself"
            raise FitError(what, where="explore", hint=hint)
    except (FitError, SceneError) as error:  # a model of the user's own, say
        plan = None
        said.append(f"There are no fitted values: {one_line(str(error))}.")
    names = [name for name in READINGS if name in (capture if plan is None else plan.request.links)]
    places = _wavelength_places(capture)
    is_own = any({*IMAGE} & {*capture[name].dims} for name in ANGLES)
    views, pixels = capture.sizes["view"], capture.sizes["y"] * capture.sizes["x"]
    numbers = pixels * views * (2 * len(names) * len(places) + is_own)
    step = math.ceil(math.sqrt(max(1.0, numbers / MOST_READINGS)))
    grid = {dim: slice(None, None, step) for dim in IMAGE}
    some = validate(mask_missing(capture.isel(grid).load()))
    fitted = {} if plan is None else _fitted(plan, some, maps.isel(grid), names)
    turn = azimuth_difference(some)
    zenith = some["view_zenith"] * xr.where(turn < 90.0, -1.0, 1.0)
    panels, codes = [], []
    for name in names:
        both = [some[name].where(some["valid"]), *([fitted[name]] if fitted else [])]
        both = list(xr.broadcast(*both))
        for place in places if "wavelength" in both[0].dims else [0]:
            found = [x.isel(wavelength=place, missing_dims="ignore") for x in both]
            coded, scale = encode(np.stack([x.transpose(*IMAGE, "view") for x in found]))
            codes.append(list(coded.reshape(len(found), -1)))
            title = style.SHORT[name]
            if "wavelength" in both[0].dims:
                title += f", {float(capture['wavelength'][place]):g} nm"
            panels.append({"title": title, "scale": scale, "kinds": len(found)})
    zenith = zenith.broadcast_like(some["valid"]) if is_own else zenith
    zenith = zenith.isel(wavelength=0, missing_dims="ignore")
    zenith = zenith.transpose(*(IMAGE if is_own else ()), "view")
    angles, scale = encode(zenith.to_numpy())
    about = {
        "panels": panels,
        "grid": [some.sizes[dim] for dim in IMAGE],
        "step": step,
        "views": views,
        "zenith": {
            "is_own": is_own,
            "scale": scale,
            "ends": style.padded_range(zenith.to_numpy(), 0.05),
        },
        "is_joined": bool((np.minimum(turn, 180.0 - turn) < IN_PLANE).all()),
    }
    which = (
        "its readings"
        if step == 1
        else f"the readings of the nearest of every {step} x {step} pixels"
    )
    said.insert(
        0,
        f"A click shows {which}, with the values that the model predicts at the posterior means, "
        "against the view zenith, which is negative on the side of the light.",
    )
    return about, {"angles": angles, "readings": codes}, said


def _fitted(
    plan: MapPlan, some: xr.Dataset, maps: xr.Dataset, names: Sequence[str]
) -> dict[str, xr.DataArray]:
    """The readings that the model predicts at the posterior means, in the unit of the capture."""
    shared = shared_parameters(maps)["q50"]
    batch = plan.batch(some)
    engine = batch.engine
    latent = {}
    for name in engine.program.supports:
        axes = engine.parameter_axes[name][0]
        known = maps[name].transpose(*IMAGE, *axes) if name in maps else shared[name]
        values = np.broadcast_to(known, [maps.sizes[dim] for dim in (*IMAGE, *axes)])
        latent[name] = values.reshape(len(batch), *values.shape[2:]).astype(np.float32)
    found = batch.run(_predictor, tuple(names), latent, single=True)
    dims = engine.layout.dims
    shape = [*(some.sizes[dim] for dim in IMAGE), *(length for _, length in dims)]
    units = dict.fromkeys(names, 1.0) | {"intensity": float(batch.pixels.static.intensity_unit)}
    order = [*IMAGE, *(name for name, _ in dims)]
    return {n: xr.DataArray(np.reshape(x, shape) * units[n], dims=order) for n, x in found.items()}


def _predictor(engine: CompiledModel, names: tuple[str, ...]) -> JitOnce:
    """Compiled: the noise-free readings of one pixel by its latent parameters."""
    program = engine.single_program
    z = jnp.zeros(program.size, jnp.float32)
    sites = jax.eval_shape(program.constrain, z)

    def predict(data: Observations, latent: dict[str, Array]) -> dict[str, Array]:
        shaped = {name: x.reshape(sites[name].shape) for name, x in latent.items()}
        fixed = handlers.substitute(program.model, data=shaped)
        trace = handlers.trace(handlers.seed(fixed, 0)).get_trace(data)
        return {name: jnp.broadcast_to(noise_free(trace, name), data.valid.shape) for name in names}

    return batched(predict)


# --- The page -------------------------------------------------------------------------------------


WIDE = {"sizing_mode": "stretch_width"}


def _page(
    name: str, sentences: Sequence[str], about: dict[str, Any], arrays: dict[str, Any]
) -> str:
    """The page, drawn by Bokeh, whose library it holds."""
    bokeh, embed = (importlib.import_module(f"bokeh.{each}") for each in ("models", "embed"))
    titles, image = about["titles"], arrays.pop("image")
    frame, drawn = _map_figure(image, about["colors"][0])
    panels, curves = _panels(about)
    range_100 = {"start": 0, "end": 100, "value": 100, "step": 1, "show_value": False}
    parts = {
        "choice": bokeh.Select(title="parameter", value=titles[0], options=titles, **WIDE),
        "label": bokeh.Div(text=ANY_WIDTH, **WIDE),
        "slider": bokeh.Slider(title=None, name="width", **range_100, **WIDE),
        "pane": bokeh.Div(text="Point at a pixel.", name="pane", **WIDE),
        "heading": bokeh.Div(text="Click a pixel." if panels else "", name="heading", **WIDE),
    }
    known = {"angles": None, "readings": None, "about": json.dumps(about), **arrays, **drawn}
    known |= {"curves": curves, "ranges": [each.y_range for each in panels], **parts}
    act = bokeh.CustomJS(args=known, code=page.read_template("explore.js"))
    for widget in ("choice", "slider"):
        parts[widget].js_on_change("value", act)
    for event in ("mousemove", "tap"):
        frame.js_on_event(event, act)
    choice, label, slider, pane, heading = parts.values()
    roots = [
        bokeh.Column(choice, label, slider, frame, **WIDE),
        bokeh.Column(pane, heading, *panels, **WIDE),
    ]
    inline = importlib.import_module("bokeh.resources").INLINE
    filled = {"template": page.template("explore.html.j2"), "title": f"Map: {name}"}
    found = embed.file_html(roots, inline, **filled, template_variables={"sentences": sentences})
    return str(found)


def _map_figure(image: np.ndarray, limits: Sequence[float]) -> tuple[Any, dict[str, Any]]:
    """The picture of a map, and what the script changes of it."""
    bokeh, plotting = (importlib.import_module(f"bokeh.{each}") for each in ("models", "plotting"))
    rows, columns = image.shape
    low, high = limits
    drawn = {
        "colors": bokeh.LinearColorMapper("Viridis256", low=low, high=high, nan_color=NO_ANSWER),
        "picture": bokeh.ColumnDataSource({"image": [image]}),
        "mark": bokeh.ColumnDataSource({"x": [], "y": []}),
    }
    frame = plotting.figure(
        x_range=(0, columns),
        y_range=(rows, 0),
        width=SIDE,
        height=round(SIDE * min(max(rows / columns, 0.3), 1.5)) + AROUND,
        sizing_mode="scale_width",
        tools="pan,wheel_zoom,box_zoom,reset,save",
        active_drag=None,  # a phone scrolls the page
        toolbar_location="above",
        name="picture",
    )
    frame.toolbar.logo, frame.axis.visible, frame.grid.visible = None, False, False
    place = {"x": 0, "y": 0, "dw": columns, "dh": rows}
    frame.image("image", source=drawn["picture"], color_mapper=drawn["colors"], **place)
    look = {"marker": "square", "size": 12, "color": None, "line_color": VERMILLION}
    frame.scatter("x", "y", source=drawn["mark"], **look)
    frame.add_layout(bokeh.ColorBar(color_mapper=drawn["colors"]), "below")
    return frame, drawn


def _panels(about: Mapping[str, Any]) -> tuple[list[Any], list[list[Any]]]:
    """A figure of readings and fitted values for each variable and wavelength, and their data."""
    bokeh, plotting = (importlib.import_module(f"bokeh.{each}") for each in ("models", "plotting"))
    panels: list[Any] = []
    curves = []
    for panel in about["panels"]:
        sources = [bokeh.ColumnDataSource({"zenith": [], "value": []}) for _ in range(2)]
        ends = {"x_range": about["zenith"]["ends"], "y_range": (0, 1)}
        figure = plotting.figure(height=190, tools="", y_axis_label=panel["title"], **ends, **WIDE)
        figure.toolbar_location, figure.name = None, f"panel {len(panels)}"
        at = {"x": "zenith", "y": "value", "color": VERMILLION, "source": sources[1]}
        if about["is_joined"]:
            figure.line(**at)
        figure.scatter(**at, marker="x", size=8)
        figure.scatter(**at | {"color": BLUE, "source": sources[0]}, size=6)
        panels.append(figure)
        curves.append(sources[: panel["kinds"]])
    for figure in panels[-1:]:
        figure.xaxis.axis_label = "view zenith [degree]"
    return panels, curves
