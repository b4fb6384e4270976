"""Which parts a capture allows, and how candidates grow."""

import xarray as xr

import polar_bayes as pb
from polar_bayes.physics.instrument import AngleZero, ChannelGain, Discrepancy
from polar_bayes.scenes.library import default_links, scene_library


def off_mirror(capture: xr.Dataset) -> xr.Dataset:
    return capture.assign(light_zenith=0.0 * capture["light_zenith"] + 45.0)


def test_a_mirror_needs_views_in_the_mirror_direction(plate: xr.Dataset) -> None:
    assert list(scene_library(plate).surfaces) == ["mirror", "sky"]
    library = scene_library(off_mirror(plate))
    assert list(library.surfaces) == ["rough surface", "sky", "rough GGX surface"]
    # Other slopes do not make a scene grow; they stand in the place of what was selected.
    assert all(choice[0] != "rough GGX surface" for choice in library.extensions(library.simplest))
    assert next(library.alternatives(library.simplest)) == ("rough GGX surface", "", "")


def test_a_beam_is_no_sky(plate: xr.Dataset) -> None:
    """The light of a goniometer is stated, and so is that of a capture with incident levels."""
    assert list(scene_library(plate.assign_attrs(setup="goniometer")).surfaces) == ["mirror"]
    assert list(scene_library(plate.assign_attrs(incident_levels="given")).surfaces) == ["mirror"]
    aside = scene_library(off_mirror(plate).assign_attrs(setup="goniometer"))
    assert list(aside.surfaces) == ["rough surface", "rough GGX surface"]
    assert "sky" in scene_library(plate.assign_attrs(setup="camera")).surfaces


def test_the_setup_gives_its_body_and_its_systematic_errors(plate: xr.Dataset) -> None:
    named = scene_library(plate.assign_attrs(setup="goniometer"))
    terms = named.others["instrument"]["systematic errors"].terms
    assert isinstance(terms[0], AngleZero)
    assert isinstance(terms[-1], Discrepancy)
    assert any(isinstance(term, ChannelGain) for term in terms)
    assert next(iter(named.bodies)) == "unpolarized body"
    assert next(iter(scene_library(plate).bodies)) == "Lambertian body"


def test_parts_that_need_a_variable_or_colors_are_absent_without_them(plate: xr.Dataset) -> None:
    assert set(scene_library(plate).others) == {"instrument"}
    with_u = plate.assign(u=0.0 * plate["q"])
    assert set(scene_library(with_u).others) == {"instrument", "normal"}


def test_a_capture_without_a_setup_gets_links_for_what_it_holds(plate: xr.Dataset) -> None:
    links = default_links(plate)
    assert links is not None
    assert links["q"].reads_errors
    assert not default_links(plate.drop_vars("q_error"))["q"].reads_errors
    assert default_links(plate.assign_attrs(setup="goniometer")) is None
    # A set-up whose links describe nothing that was measured is as good as none.
    assert default_links(plate.assign_attrs(setup="paper")) is not None


def test_extensions_add_one_part_and_alternatives_exchange_or_remove_one(
    plate: xr.Dataset,
) -> None:
    library = scene_library(plate)
    assert library.simplest == ("mirror", "", "")
    assert list(library.extensions(library.simplest)) == [
        ("sky", "", ""),
        ("mirror", "Lambertian body", ""),
        ("mirror", "", "systematic errors"),
    ]
    whole = ("sky", "Lambertian body", "systematic errors")
    assert list(library.alternatives(whole)) == [
        ("sky", "unpolarized body", "systematic errors"),
        ("sky", "", "systematic errors"),
        ("sky", "Lambertian body", ""),
        ("mirror", "Lambertian body", "systematic errors"),
    ]
    assert list(library.other_bodies(whole)) == [("sky", "unpolarized body", "systematic errors")]
    assert not list(library.other_bodies(library.simplest))
    assert {type(scene) for scene in library.single_parts()} == {pb.Scene}
    assert library.scene(whole).has(Discrepancy)
