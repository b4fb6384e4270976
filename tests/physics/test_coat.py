"""Coats and films as a user writes them: against tables, and as parts of a scene."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from optics import directions, incidence, one_by_one, read, stokes_of
from scipy.integrate import quad

from polar_bayes.physics.coat import AbstractCoat, BackFace, ClearCoat, CoatStack, ThinFilm
from polar_bayes.physics.illumination import PointSource
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Layer, Stack
from polar_bayes.physics.stokes import LinearPolarization
from polar_bayes.physics.subsurface import Lambertian
from polar_bayes.physics.surface import InternalReflection, SmoothSurface

VIEWS = directions(
    [0.0, 20.0, 45.0, 60.0, 85.0],
    [180.0, 180.0, 170.0, 60.0, 180.0],
    [0.0, 30.0, 45.0, 60.0, 85.0],
    wavelength=550.0,
)
MATERIAL = {"refractive_index": 1.6, "subsurface_fraction": 1.0}


def reflected(coat: AbstractCoat, zenith: np.ndarray, body: np.ndarray, wavelength=None, **values):
    """s and p of one facet."""
    parameters = {name: jnp.asarray(value) for name, value in values.items()}
    stack = Stack(jnp.asarray(body), coat.layers(parameters, wavelength))
    return one_by_one(stack.reflection(*incidence(zenith)))[:2]


def test_a_thick_coat_agrees_with_the_table() -> None:
    """The closed form to the table's ten digits; the transfer-matrix code without absorption.

    With absorption that code's index is complex, so that its boundaries reflect up to 4.7e-7 more.
    """
    coat, body, absorbance, zenith, *codes, s_closed, p_closed, dolp = read(
        "coat_incoherent_inc_tmm.csv"
    )
    s, p = found = reflected(
        ClearCoat(), zenith, body, coat_refractive_index=coat, coat_absorbance=absorbance
    )
    np.testing.assert_allclose(found, [s_closed, p_closed], atol=6e-11)
    clear = absorbance == 0.0
    assert 0 < clear.sum() < clear.size
    np.testing.assert_allclose(found[:, clear], np.array(codes)[:, clear], atol=1e-9)
    np.testing.assert_allclose(found[:, ~clear], np.array(codes)[:, ~clear], atol=5e-7)
    np.testing.assert_allclose(((s - p) / (s + p))[clear], dolp[clear], atol=1e-9)


def test_a_film_agrees_with_the_table() -> None:
    n, body, thickness, wavelength, zenith, *tables, dolp = read("thinfilm_coherent_tmm.csv")
    s, p = found = reflected(
        ThinFilm(),
        zenith,
        body,
        jnp.asarray(wavelength),
        film_refractive_index=n,
        film_thickness=thickness,
    )
    for table in (tables[:2], tables[2:]):  # the code, and Airy's form
        np.testing.assert_allclose(found, table, atol=1e-9)
    np.testing.assert_allclose((s - p) / (s + p), dolp, atol=2e-9)


@pytest.mark.thorough
def test_a_body_under_a_coat_of_its_own_index() -> None:
    """T+(l) e^(-tau/mu_l) [T+, T-](v) e^(-tau/mu_v) A/(pi n^2 (1 - A Fi_tau)).

    Fi_tau is the integral over the cosine inside of what the air boundary returns, twice filtered.
    """
    n, tau, albedo = 1.6, 0.3, 0.7
    body = Lambertian(albedo, InternalReflection())
    scene = Scene(SmoothSurface(), body, StokesMixing(), coat=ClearCoat(n, tau))
    found = stokes_of(scene, MATERIAL, VIEWS)
    critical = np.sqrt(1.0 - 1.0 / n**2)

    def mirrored(inner: float) -> float:
        outer = np.sqrt(1.0 - n**2 * (1.0 - inner**2) + 0j)
        s = np.abs((n * inner - outer) / (n * inner + outer)) ** 2
        p = np.abs((n * outer - inner) / (n * outer + inner)) ** 2
        return (s + p) * inner * np.exp(-2.0 * tau / inner)

    returned = sum(quad(mirrored, *ends)[0] for ends in ((1e-9, critical), (critical, 1.0)))
    bare = Stack(jnp.asarray(n))
    ends = incidence(VIEWS.light_zenith), incidence(VIEWS.view_zenith)
    into, out = (bare.transmission(*end) for end in ends)
    slant = sum(1.0 / np.sqrt(1.0 - b / n**2) for _, b in ends)
    bright = albedo / (np.pi * n**2 * (1.0 - albedo * returned)) * np.exp(-tau * slant)
    bright = bright * ends[0][0] * into.mean
    np.testing.assert_allclose(found[:, 0], bright * out.mean, rtol=1e-6)
    expected = bright * out.contrast * ends[1][1]
    np.testing.assert_allclose(found[:, 1], expected, rtol=1e-6, atol=1e-16)


def test_fringes_move_with_color_and_angle() -> None:
    """At normal incidence a half wave is missing; the next is as bright as no film."""
    colors = jnp.array([[460.0], [920.0]])  # 230 nm of 2.0 are a full and a half wave
    views = VIEWS._replace(wavelength=colors)
    film = Scene(SmoothSurface(), coat=ThinFilm(2.0, 230.0))
    found = stokes_of(film, MATERIAL, views)
    bare = stokes_of(Scene(SmoothSurface()), MATERIAL, views)
    assert found.shape == (2, 5, 3)
    np.testing.assert_allclose(found[:, 0, 0], bare[0, 0], rtol=1e-12)
    assert np.all(np.abs(found[:, 2:, 0] / bare[None, 2:, 0] - 1.0) > 1e-3)


def test_a_clear_coat_has_no_filter_in_the_program() -> None:
    assert ClearCoat(1.5, 0.0).layers({}, None) == (Layer(jnp.asarray(1.5), None, None),)
    assert ClearCoat(1.5, 0.1).layers({}, None)[0].absorbance is not None


# --- The back of a plate --------------------------------------------------------------------------

DEGREES = np.array([0.0, 20.0, 45.0, 56.3, 75.0, 89.9])
BESIDE = directions(DEGREES, 180.0, DEGREES, 0.0, 550.0)


@each("absorbance", [0.0, 0.4])
def test_a_share_of_the_light_from_the_back_adds_to_that_of_the_front(absorbance: float) -> None:
    """R + share T^2 A^2 R/(1 - A^2 R^2) for s and p, from amplitudes."""
    n, share = 1.515, 0.7
    scene = Scene(SmoothSurface(back=BackFace("back_face_share", absorbance)))
    light = stokes_of(scene, {"refractive_index": n, "back_face_share": share}, BESIDE)
    cos, sin = np.cos(np.radians(DEGREES)), np.sin(np.radians(DEGREES))
    inside = np.sqrt(1.0 - (sin / n) ** 2)
    passed = np.exp(-2.0 * absorbance / inside)
    for sign, mirrored in (
        (1.0, ((cos - n * inside) / (cos + n * inside)) ** 2),
        (-1.0, ((n * cos - inside) / (n * cos + inside)) ** 2),
    ):
        back = (1.0 - mirrored) ** 2 * passed * mirrored / (1.0 - passed * mirrored**2)
        found = light[:, 0] + sign * light[:, 1]
        np.testing.assert_allclose(found, mirrored + share * back, rtol=1e-12, atol=1e-15)
        assert np.all(found <= 1.0 + 1e-15)  # nothing is gained, even at grazing


@each("film", [ThinFilm(1.38, 100.0), None], quick=1)
def test_the_whole_back_is_a_coat_on_air_and_none_of_it_is_a_plate(film: ThinFilm | None) -> None:
    """In polarized light and under a film, too: a coat of the plate's index on a body of 1."""
    beam, n = PointSource(LinearPolarization(0.6, 30.0)), 1.515
    plate, coats = ClearCoat(n, 0.1), (film,) if film else ()
    over_air = Scene(SmoothSurface(beam), coat=CoatStack((*coats, plate)))
    bare = Scene(SmoothSurface(beam), coat=film)
    scene = Scene(SmoothSurface(beam, BackFace("back_face_share", 0.1)), coat=film)
    for share, same, index in ((1.0, over_air, 1.0), (0.0, bare, n)):
        found = stokes_of(scene, {"refractive_index": n, "back_face_share": share}, BESIDE)
        expected = stokes_of(same, {"refractive_index": index}, BESIDE)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
