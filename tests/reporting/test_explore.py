"""A map that one can point at: what its page holds, and what a real pointer is shown."""

import json
import re
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from browsers import WIDTHS, browser, faults, open_page
from cases import each
from plate_images import VIEWS, plate_image
from plates import LINKS, PLATE
from reporting.test_pages import mixed
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from synthetic_maps import make_maps
from textbook import plate_q

import polar_bayes as pb
from polar_bayes.inference.batching import Status
from polar_bayes.inference.request import resolve
from polar_bayes.inference.result import PROVENANCE, provenance_of
from polar_bayes.maps.lazy import map_parameters
from polar_bayes.models.sites import SPECTRAL
from polar_bayes.observation.data import ANGLES, READINGS
from polar_bayes.reporting import page
from polar_bayes.reporting.explore import (
    CODES,
    encode,
    map_numbers,
    map_readings,
    shown_parameters,
)

SETUP = pb.setups.Setup(PLATE, LINKS)


def plates(rows: int = 6, columns: int = 9) -> tuple[xr.Dataset, xr.Dataset]:
    """Maps of plates, one of which failed and one of which is wide, and their capture."""
    capture = plate_image(rows, columns, seed=3)
    request = resolve(capture.isel(y=0, x=0), "per_material", SETUP, None, None, None, 0, "double")
    means = {
        n: capture[f"true_{n}"].to_numpy() for n in ("refractive_index", "subsurface_fraction")
    }
    means["stokes_error_factor"] = np.ones((rows, columns))
    width = np.full((rows, columns), 0.1)
    width[0, 1] = 0.5
    status = np.full((rows, columns), Status.GOOD)
    status[2, 3] = Status.NOT_CONVERGED
    return make_maps(means, width=width, status=status, **request.describe()), capture


def decoded(codes: np.ndarray, scale: dict) -> np.ndarray:
    """Numbers as the script reads them."""
    x = scale["low"] + scale["step"] * (codes.astype(float) - 1.0)
    return np.where(codes == 0, np.nan, np.exp(x) if scale["is_log"] else x)


# --- What the page holds --------------------------------------------------------------------------


@each("spread", [1.0, 1e6])
def test_integers_keep_five_digits_and_what_is_missing(spread: float) -> None:
    values = np.array([[0.5, np.nan, 0.5 * spread], [0.123456 * spread, np.inf, 0.7]])
    found = decoded(*encode(values))
    expected = np.where(np.isfinite(values), values, np.nan).ravel()
    relative = np.log(spread) if spread > 100.0 else 1.0
    np.testing.assert_allclose(found, expected, rtol=2.0 * relative / CODES)


@each("maps", [mixed, lambda: plates()[0]], ids=["mixed", "plates"])
def test_every_number_of_every_pixel_is_on_the_page(maps) -> None:
    maps = maps()
    about, arrays = map_numbers(maps, shown_parameters(maps))
    assert about["bin"] == 1
    statuses = [about["statuses"][i] for i in arrays["trust"][0]]
    assert {n: statuses.count(n) for n in set(statuses)} == {
        n: count for n, count in pb.maps.count_pixels(maps).items() if count
    }
    for scalar, codes, scales in zip(
        shown_parameters(maps), arrays["codes"], about["scales"], strict=True
    ):
        quantiles = maps[f"{scalar.name}_quantile"]
        expected = maps[scalar.name], *(quantiles.sel(quantile=q) for q in (0.025, 0.975))
        for code, scale, values in zip(codes, scales, expected, strict=True):
            atol = np.ptp(values.to_numpy()[np.isfinite(values)]) / 60_000
            np.testing.assert_allclose(decoded(code, scale), values.to_numpy().ravel(), atol=atol)


def test_of_many_wavelengths_three_are_shown() -> None:
    colors = tuple(np.linspace(400.0, 700.0, 7))
    maps = make_maps({"absorption": np.ones((3, 4, 7)) * np.arange(7)}, wavelengths=colors)
    about, _ = map_numbers(maps, shown_parameters(maps))
    assert [re.findall(r"\d+ nm", title) for title in about["titles"]] == [
        ["400 nm"], ["550 nm"], ["700 nm"],
    ]  # fmt: skip
    assert "Of 7 wavelengths, 400, 550, 700 nm are shown." in pb.explore(maps).html


def test_a_map_of_more_than_a_million_pixels_is_binned_and_says_so() -> None:
    values = 1e6 + np.arange(1001 * 1000.0).reshape(1001, 1000)
    status = np.full(values.shape, Status.GOOD)
    status[0, :2], status[1, 0] = Status.MASKED, Status.MASKED
    maps = make_maps({"roughness": values}, status=status)
    about, arrays = map_numbers(maps, shown_parameters(maps))
    assert (about["bin"], about["shape"]) == (2, (501, 500))
    mean = decoded(arrays["codes"][0][0], about["scales"][0][0]).reshape(501, 500)
    np.testing.assert_allclose(
        mean[0, :2], [1_001_001.0, 1_000_502.5], atol=20.0
    )  # of 1, and of 4 pixels
    np.testing.assert_allclose(mean[500, 1], 2_000_002.5, atol=20.0)  # the last row has no partner
    said = [about["statuses"][i] for i in arrays["trust"][0][:2]]
    assert said == ["masked", "good"]
    assert "more than 1,000,000 pixels: a bin of 2 x 2 shows the means" in pb.explore(maps).html


@pytest.mark.usefixtures("compiled_in_haste")
def test_fitted_values_are_those_of_a_textbook_at_the_posterior_means(monkeypatch) -> None:
    maps, capture = plates()
    monkeypatch.setattr(sys.modules[map_readings.__module__], "MOST_READINGS", 200)
    about, arrays, said = map_readings(maps, capture)
    assert (about["step"], about["grid"], len(about["panels"])) == (2, [3, 5], 1)
    assert "the readings of the nearest of every 2 x 2 pixels" in said[0]
    measured, fitted = (decoded(x, about["panels"][0]["scale"]) for x in arrays["readings"][0])
    some = {"y": slice(None, None, 2), "x": slice(None, None, 2)}
    index, fraction = (
        maps[n].isel(some).to_numpy()[..., None]
        for n in ("refractive_index", "subsurface_fraction")
    )
    tolerance = {"rtol": 0.0, "atol": 1e-4}
    expected = plate_q(index, fraction, np.radians(VIEWS))
    np.testing.assert_allclose(fitted, expected.ravel(), **tolerance)
    np.testing.assert_allclose(measured, capture["q"].isel(some).to_numpy().ravel(), **tolerance)
    np.testing.assert_allclose(
        decoded(arrays["angles"], about["zenith"]["scale"]), VIEWS, atol=0.01
    )
    assert about["is_joined"]


@pytest.mark.usefixtures("compiled_in_haste")
def test_a_map_in_a_store_is_predicted_with_what_its_pixels_share(tmp_path: Path) -> None:
    maps, capture = plates()
    quantiles = {"0.025": 0.9, "0.5": 1.0, "0.975": 1.1}
    shared = {"quantiles": quantiles, "pixels": 53, "disagreement": 0.1}
    about = provenance_of(maps) | {"shared": {"stokes_error_factor": shared}}
    own = [name for name in maps if not name.startswith("stokes_error_factor")]
    maps = maps[own].assign_attrs({PROVENANCE: json.dumps(about)})
    maps.chunk(y=3, x=5).to_zarr(tmp_path / "maps.zarr", consolidated=False)
    stored = pb.maps.open_map(tmp_path / "maps.zarr")
    assert list(pb.maps.shared_parameters(stored).index) == ["stokes_error_factor"]
    assert {x.name for x in shown_parameters(stored)} == {"refractive_index", "subsurface_fraction"}
    about, arrays, _ = map_readings(stored, capture)
    assert about["panels"][0]["kinds"] == 2
    fitted = decoded(arrays["readings"][0][1], about["panels"][0]["scale"])
    means = (maps[n].to_numpy()[..., None] for n in ("refractive_index", "subsurface_fraction"))
    expected = plate_q(*means, np.radians(VIEWS)).ravel()
    known = np.isfinite(expected)
    np.testing.assert_allclose(fitted[known], expected[known], rtol=0.0, atol=1e-4)
    assert "refractive index n" in pb.explore(stored).html


def test_each_pixel_may_have_directions_of_its_own() -> None:
    maps, capture = plates()
    shifted = capture["view_zenith"] + xr.DataArray(np.linspace(-5.0, 5.0, 9), dims="x")
    capture["view_zenith"] = shifted.broadcast_like(capture["q"])
    capture["light_azimuth"] = capture["light_azimuth"] + 30.0
    maps.attrs.clear()  # which is a map of no scene that is known
    about, arrays, said = map_readings(maps, capture)
    zenith = decoded(arrays["angles"], about["zenith"]["scale"])
    expected = shifted.broadcast_like(capture["q"]).transpose("y", "x", "view").to_numpy()
    np.testing.assert_allclose(zenith, expected.ravel(), atol=0.01)
    assert about["zenith"]["is_own"]
    assert not about["is_joined"]
    assert said[1].startswith("There are no fitted values: scene: it states no scene")
    assert about["panels"][0]["kinds"] == 1


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled_in_haste")
@each(
    ("scene", "wavelengths", "shared"),
    [
        ("camera", (), {}),
        ("camera", (), {"light_zenith_offset": 2.0}),
        ("paper", (450.0, 550.0, 600.0, 650.0), {}),
    ],
)
def test_fitted_values_are_those_of_the_scene(scene: str, wavelengths: tuple, shared: dict) -> None:
    protocol = pb.simulation.Protocol(views=10, wavelengths=wavelengths)
    one = pb.simulate("plastic", scene=scene, protocol=protocol, seed=1)
    request = resolve(one, "per_material", *[None] * 4, 0, "double", shared=tuple(shared))
    own = {n: wavelengths if n in SPECTRAL else () for n in request.priors if n not in shared}
    sizes = {name: (2, 3, *([len(axis)] if axis else [])) for name, axis in own.items()}
    rng = np.random.default_rng(0)
    means = {name: rng.uniform(0.4, 0.6, size) for name, size in sizes.items()}
    means["refractive_index"] += 1.0
    about, levels = {"pixels": 512, "disagreement": 0.0}, ("0.025", "0.5", "0.975")
    found = {n: {**about, "quantiles": dict.fromkeys(levels, x)} for n, x in shared.items()}
    maps = make_maps(means, wavelengths=wavelengths, shared=found, **request.describe())
    capture = one.expand_dims(y=2, x=3).copy(deep=True)
    capture["view_zenith"] += rng.normal(0.0, 0.5, capture["view_zenith"].shape)

    about, arrays, _ = map_readings(maps, capture)
    shown = [0, 2, 3] if wavelengths else [None]
    panels = iter(zip(about["panels"], arrays["readings"], strict=True))
    angles = {name: capture[name][1, 2].to_numpy() for name in ANGLES}
    for name in filter(request.links.__contains__, READINGS):
        for color in shown:
            at = {n: x[1, 2] if x.ndim == 2 else x[1, 2, color] for n, x in means.items()}
            light = {} if color is None else {"wavelength": wavelengths[color]}
            geometry = pb.Geometry.from_degrees(**angles, **light)
            expected = np.asarray(request.scene.predict(at | shared, geometry)[name])
            expected = expected * (at["exposure"] if name == "intensity" else 1.0)
            panel, kinds = next(panels)
            fitted = decoded(kinds[1], panel["scale"]).reshape(2, 3, -1)[1, 2]
            np.testing.assert_allclose(fitted, expected, rtol=1e-3, atol=1e-4)
    assert next(panels, None) is None


# --- What is refused ------------------------------------------------------------------------------


@each("result", [xr.DataTree(), xr.Dataset(), None])
def test_what_is_no_map_is_refused(result) -> None:
    with pytest.raises(pb.FitError, match="explore: it holds no maps; give what fit_pixels"):
        pb.explore(result)


def test_a_capture_of_another_image_is_refused() -> None:
    maps, capture = plates()
    with pytest.raises(pb.CaptureError, match="axis x has 8 pixels, that of the maps 9; give the"):
        pb.explore(maps, capture.isel(x=slice(8)))


def test_without_the_library_the_report_says_what_to_install(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "bokeh", None)
    with pytest.raises(pb.FitError, match=r"Bokeh, is not installed; pip install .*explore"):
        pb.explore(mixed())
    assert "no map to point at" in pb.report(mixed(), tmp_path / "report").read_text()
    assert not (tmp_path / "report" / page.EXPLORER).exists()


def test_a_page_is_saved_over_one_of_its_kind_only(tmp_path: Path) -> None:
    made, other = pb.explore(mixed(), None), tmp_path / "other.html"
    for _ in range(2):
        assert made.save(tmp_path / "explore.html").read_text() == made.html
    other.write_text("mine")
    with pytest.raises(pb.OutputError):
        made.save(other)
    assert other.read_text() == "mine"
    assert "srcdoc" in made._repr_html_()


# --- A real pointer -------------------------------------------------------------------------------

READY = """return window.Bokeh !== undefined && Bokeh.documents.length > 0
  && Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name('picture')) !== null"""
FRAME = """const picture = Bokeh.documents[0].get_model_by_name('picture')
const view = Bokeh.index.find_one(picture)
const whole = view.canvas_view.el.getBoundingClientRect(), frame = view.frame.bbox
return [whole.left + frame.left, whole.top + frame.top, frame.width, frame.height]"""
TEXT = """return Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name(arguments[0]))
  .shadow_el.textContent"""
SHOWN = """const picture = Bokeh.documents[0].get_model_by_name('picture')
return [...picture.renderers[0].data_source.data.image[0]].filter(Number.isFinite).length"""
CURVE = """return Bokeh.documents[0].get_model_by_name('panel 0').renderers.at(arguments[0])
  .data_source.data.value"""
FOCUS = """Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name('width'))
  .shadow_el.querySelector('.noUi-handle').focus()"""
RESOURCES = "return performance.getEntriesByType('resource').map(entry => entry.name)"


def until(driver: webdriver.Chrome, question, wanted) -> object:
    """The answer, once it is as wanted."""
    end = time.monotonic() + 60.0
    while not wanted(found := question(driver)) and time.monotonic() < end:
        time.sleep(0.05)
    assert wanted(found), found
    return found


def point(driver: webdriver.Chrome, y: int, x: int, shape: tuple[int, int]) -> ActionChains:
    """Move the pointer to the middle of a pixel."""
    left, top, width, height = driver.execute_script(FRAME)
    place = left + width * (x + 0.5) / shape[1], top + height * (y + 0.5) / shape[0]
    actions = ActionChains(driver)
    actions.w3c_actions.pointer_action.move_to_location(*map(round, place))
    return actions


@pytest.mark.usefixtures("compiled_in_haste")
def test_a_pointer_reads_a_pixel_a_click_its_readings_and_a_slider_hides_wide_ones(
    tmp_path: Path,
) -> None:
    maps, capture = plates()
    shape = (6, 9)
    file = pb.explore(maps, capture).save(tmp_path / "explore.html")
    with browser(tmp_path) as driver:
        for width in WIDTHS:
            open_page(driver, file, width)
            until(driver, lambda d: d.execute_script(READY), bool)
            assert faults(driver) == []
        point(driver, 2, 3, shape).perform()
        until(driver, lambda d: d.execute_script(TEXT, "pane"), lambda x: "y 2, x 3: not conv" in x)
        point(driver, 4, 5, shape).perform()
        said = until(driver, lambda d: d.execute_script(TEXT, "pane"), lambda x: "y 4, x 5" in x)
        assert "y 4, x 5: good, Pareto k 0.20" in said
        for name in map_parameters(maps):
            mean = maps[name][4, 5].item()
            ends = (maps[f"{name}_quantile"].sel(quantile=q)[4, 5] for q in (0.025, 0.975))
            low, high = (each.item() for each in ends)
            assert f"{mean:.3f}[{low:.3f}, {high:.3f}]" in re.sub(r"\s*(?=\[)", "", said)

        point(driver, 4, 5, shape).click().perform()
        until(driver, lambda d: d.execute_script(TEXT, "heading"), lambda x: "y 4, x 5" in x)
        readings = capture["q"][4, 5].to_numpy()
        np.testing.assert_allclose(driver.execute_script(CURVE, -1), readings, atol=1e-4)
        fitted = plate_q(
            maps["refractive_index"][4, 5].item(),
            maps["subsurface_fraction"][4, 5].item(),
            np.radians(VIEWS),
        )
        np.testing.assert_allclose(driver.execute_script(CURVE, 0), fitted, atol=1e-4)

        assert driver.execute_script(SHOWN) == 53  # all but the failed one
        driver.execute_script(FOCUS)
        ActionChains(driver).send_keys(Keys.ARROW_LEFT).perform()
        until(driver, lambda d: d.execute_script(SHOWN), lambda n: n == 52)
        assert driver.execute_script(RESOURCES) == []
        assert faults(driver) == []
