"""Captures side by side: nothing lost, nothing made up, and what does not fit is told by name."""

import numpy as np
import pytest
import xarray as xr
from cases import each

from polar_bayes.capture.combine import combine
from polar_bayes.capture.files import load_capture, save_capture
from polar_bayes.capture.schema import CONTRACT, count, validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.goniometer import from_goniometer
from polar_bayes.observation.data import observe


def refused(captures, what, **options):
    """The one-line message of the refusal."""
    with pytest.raises(CaptureError, match=what) as caught:
        combine(captures, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def pair(make_capture):
    """Two captures, the second with three views of five."""
    return {
        "glass": validate(make_capture()),
        "plexiglas": validate(make_capture(seed=1).isel(view=[0, 2, 3])),
    }


@each("dim", ["material", "patch"])
@each("spectral", [False, True])
def test_every_number_comes_through_and_the_rest_is_not_valid(make_capture, dim, spectral):
    pair = {
        "glass": validate(make_capture(spectral=spectral)),
        "plexiglas": validate(make_capture(spectral=spectral, seed=1).isel(view=[0, 2, 3])),
    }
    both = combine(pair, dim=dim)
    assert both.sizes[dim] == 2
    assert both[dim].values.tolist() == ["glass", "plexiglas"]
    assert both["dop"].dims == (dim, "view", *(("wavelength",) if spectral else ()))
    for label, capture in pair.items():
        one = both.sel({dim: label}).isel(view=slice(capture.sizes["view"]))
        for name in (*(row.name for row in CONTRACT), "true_roughness"):
            np.testing.assert_array_equal(one[name], capture[name])
            assert both[name].attrs == capture[name].attrs
    padding = both.sel({dim: "plexiglas"}).isel(view=slice(3, None))
    assert not padding["valid"].any()
    assert not padding["saturated"].any()
    assert np.isnan(padding["dop"]).all()
    xr.testing.assert_identical(validate(both), both)
    assert count(both)["masked"] == sum(count(one)["masked"] for one in pair.values()) + (
        2 * both.sizes.get("wavelength", 1)
    )


def test_what_was_filled_up_reaches_no_model(pair):
    data = observe(combine(pair))
    assert data.dims == (("material", 2), ("view", 5))
    alone = observe(pair["plexiglas"])
    np.testing.assert_array_equal(data.valid[1], [*alone.valid, False, False])
    np.testing.assert_array_equal(data.geometry.view_zenith[1, :3], alone.geometry.view_zenith)
    for readings in (data.readings, data.errors):
        for value in readings.values():
            assert np.all(np.isfinite(value))


def test_directions_are_those_of_each(pair):
    both = combine(pair)
    assert both["view_zenith"].dims == ("material", "view")
    zenith = both["view_zenith"].values
    np.testing.assert_array_equal(zenith[1], pair["plexiglas"]["view_zenith"][[0, 1, 2, 2, 2]])


@pytest.mark.thorough
def test_attributes_that_all_share_are_kept(pair):
    pair["glass"].attrs |= {"setup": "goniometer", "operator": "Ada", "shots": 1, "lamp": 2}
    pair["plexiglas"].attrs |= {"setup": "goniometer", "operator": "Bob"}
    del pair["plexiglas"].attrs["shots"]
    attributes = combine(pair).attrs
    assert attributes == {"name": "glass, plexiglas", "setup": "goniometer", "lamp_current": 1.5}


@pytest.mark.thorough
def test_what_one_does_not_say_has_its_plain_meaning(pair):
    no_progress = ["valid", "saturated", "interpolated", "normal_confidence", "true_roughness"]
    pair["plexiglas"] = pair["plexiglas"].drop_vars(no_progress)
    pair["plexiglas"]["true_absorption"] = 0.3
    both = combine(pair)
    np.testing.assert_array_equal(both["valid"][1], [True, True, True, False, False])
    assert not both["saturated"][1].any()
    assert not both["interpolated"][1].any()
    np.testing.assert_array_equal(both["normal_confidence"], [0.5, 1.0])
    np.testing.assert_array_equal(both["true_roughness"], [0.2, np.nan])
    np.testing.assert_array_equal(both["true_absorption"], [np.nan, 0.3])


@pytest.mark.thorough
def test_trust_and_truth_take_the_dims_that_they_need(pair):
    views = np.array([0.2, 0.4, 0.6])
    pair["plexiglas"] = pair["plexiglas"].assign(
        normal_confidence=("view", views), true_roughness=("view", views)
    )
    both = combine(pair)
    np.testing.assert_array_equal(both["normal_confidence"], [[0.5] * 5, [0.2, 0.4, 0.6, 0.6, 0.6]])
    np.testing.assert_array_equal(
        both["true_roughness"], [[0.2] * 5, [0.2, 0.4, 0.6, np.nan, np.nan]]
    )


@pytest.mark.thorough
def test_one_capture_and_three_combine_too(make_capture):
    assert combine({"leaf": make_capture()}).sizes["material"] == 1
    three = {name: make_capture(seed=i) for i, name in enumerate("abc")}
    assert combine(three, dim="patch").attrs["name"] == "a, b, c"


@pytest.mark.thorough
def test_a_label_that_selection_left_gives_way(make_capture):
    old = make_capture("material").assign_coords(material=["oak", "ash", "elm"])
    both = combine({"first": old.isel(material=0), "last": old.isel(material=2)})
    assert both["material"].values.tolist() == ["first", "last"]


def test_it_survives_a_file(pair, tmp_path):
    both = combine(pair)
    save_capture(both, tmp_path / "both.nc")
    xr.testing.assert_identical(load_capture(tmp_path / "both.nc"), both)


@pytest.mark.thorough
def test_the_given_captures_are_left_alone(pair):
    before = {label: capture.copy(deep=True) for label, capture in pair.items()}
    combine(pair)["dop"][:] = 0.5
    for label, capture in pair.items():
        xr.testing.assert_identical(capture, before[label])


def test_the_measured_plates_combine(measured):
    """Of 73 and 31 angles, at other directions, from tables of other kinds."""
    glass = from_goniometer(
        measured / "glass_fresnel" / "s1.txt",
        measured / "glass_fresnel" / "p1.txt",
        s_incident=1910.0,
        p_incident=1630.0,
    )
    plexiglas = from_goniometer(
        "I_s_uA",
        "I_p_uA",
        table=measured / "plexiglas_fresnel" / "plexiglas_A.csv",
        angle="angle_deg",
    )
    pair = {"glass": glass, "plexiglas": plexiglas}
    assert "--drop intensity" in refused(pair, "units of intensity is arbitrary, that of glass 1")
    both = combine(pair, drop=["intensity"])
    assert not {"intensity", "intensity_error"} & set(both)
    assert both.attrs["setup"] == "goniometer"
    valid = observe(both, largest_view_zenith=78.0).valid
    for row, capture in zip(valid, pair.values(), strict=True):
        alone = observe(capture, largest_view_zenith=78.0).valid
        assert int(row.sum()) == int(alone.sum()) > 10


# --- what does not fit --------------------------------------------------------------------------


@each("dim", ["y", "view", "wavelength", "sample", None])
def test_another_dim_is_refused(pair, dim):
    assert "give 'material' or 'patch'" in refused(pair, "dim=", dim=dim)


@each("captures", [{}, [], None, "glass.nc"])
def test_nothing_to_combine_is_refused(captures):
    assert "give a mapping such as {'glass'" in refused(captures, "there is nothing to combine")


def test_a_label_is_text(pair):
    assert "name every capture" in refused({1: pair["glass"]}, "combine: 1 is no label")


@pytest.mark.thorough
@each("leading", [("material",), ("patch",), ("y", "x")], ids=str)
def test_a_capture_of_several_is_refused(make_capture, leading):
    several = {"leaf": make_capture(), "oak": make_capture(*leading)}
    message = refused(several, f"combine: oak: it has the dim {leading[0]} already")
    assert f"select one with isel({leading[0]}=0)" in message


@pytest.mark.thorough
def test_an_invalid_capture_is_named(pair):
    pair["plexiglas"]["dop"][2] = 7.0
    assert refused(pair, "7 is outside").startswith("combine: plexiglas: dop[view=2]: ")


@each("lacks", ["glass", "plexiglas"])
def test_readings_must_be_the_same(pair, lacks):
    other = next(label for label in pair if label != lacks)
    pair[lacks] = pair[lacks].drop_vars(["intensity", "intensity_error"])
    message = refused(pair, f"{lacks} has no intensity, and {other} has; add it there, or leave it")
    assert "drop=['intensity'], in a command --drop intensity" in message
    assert "intensity_error" not in combine(pair, drop=["intensity"])


def test_something_must_be_left(pair):
    assert "add dop, q or intensity" in refused(
        pair, "combine: glass: no reading is there", drop=["dop", "q", "intensity"]
    )


@pytest.mark.thorough
def test_wavelengths_must_be_the_same(make_capture):
    one, other = (make_capture(spectral=True) for _ in range(2))
    other = other.assign_coords(wavelength=[633.0, 500.0])
    message = refused({"a": one, "b": other}, "combine: b: wavelength is 633.0, 500.0, that of a ")
    assert "give captures of the same wavelengths" in message
    message = refused({"a": one, "b": make_capture()}, "combine: b: wavelength is not stated")
    labeled = make_capture().assign_coords(wavelength=633.0)
    refused({"a": make_capture(), "b": labeled}, "wavelength is 633.0, that of a not stated")


@pytest.mark.thorough
def test_labels_of_views_must_be_the_same(pair):
    pair["glass"] = pair["glass"].assign_coords(view=np.arange(5))
    assert "drop_vars('view')" in refused(pair, "combine: plexiglas: view is not stated, that of g")
    both = combine({"a": pair["glass"], "b": pair["glass"]})
    np.testing.assert_array_equal(both["view"], np.arange(5))


def test_units_and_saturation_levels_must_agree(pair):
    pair["plexiglas"]["intensity"].attrs["saturation_level"] = 80.0
    message = refused(pair, "saturation_level of intensity is 80.0, that of glass 40.0")
    assert "bring both to one, or leave it out" in message
    del pair["plexiglas"]["intensity"].attrs["saturation_level"]
    refused(pair, "saturation_level of intensity is not stated, that of glass 40.0")
    for name in ("intensity", "intensity_error"):
        pair["plexiglas"][name].attrs |= {"units": "mA", "saturation_level": 40.0}
    refused(pair, "units of intensity is mA, that of glass uA; bring both to one, or")
