"""Ellipsometers: q and u of psi and delta, their errors, Mueller elements, three makers' files."""

import re

import numpy as np
import pytest
from cases import each
from numpyro import distributions as dist

import polar_bayes as pb
from polar_bayes.errors import CaptureError

ANGLES = np.arange(40.0, 72.0, 4.0)


def amplitudes(angle, index=1.5):
    """Reflected amplitudes of s and p, by Fresnel, as ellipsometers count their phases."""
    cos_in = np.cos(np.deg2rad(angle))
    cos_out = np.sqrt(1.0 - (np.sin(np.deg2rad(angle)) / index) ** 2)
    s = (cos_in - index * cos_out) / (cos_in + index * cos_out)
    p = (index * cos_in - cos_out) / (index * cos_in + cos_out)
    return s, p


def psi_delta(index=1.5):
    """The ellipsometric angles of a mirror, degree."""
    s, p = amplitudes(ANGLES, index)
    ratio = p / s
    return np.rad2deg(np.arctan(np.abs(ratio))), np.where(ratio < 0.0, 180.0, 0.0)


@pytest.fixture
def write(tmp_path):
    """A function that writes a table of columns and gives its path."""

    def write_table(names, *columns, name="e.csv", separator=","):
        rows = [separator.join(f"{x:.10g}" for x in row) for row in zip(*columns, strict=True)]
        path = tmp_path / name
        path.write_text("\n".join([names, *rows]))
        return path

    return write_table


def test_a_mirror_predicts_what_an_ellipsometer_reads(write):
    """q and u of psi and delta are those of the scene lit by the light that u states."""
    psi, delta = psi_delta()
    capture = pb.from_ellipsometer(
        write("a,P,D", ANGLES, psi, delta), angle="a", psi="P", delta="D"
    )
    light = pb.physics.LinearPolarization(angle=capture["u"].attrs["light_angle"])
    scene = pb.Scene(pb.SmoothSurface(beam=pb.PointSource(light)))
    mirror = pb.Geometry.from_degrees(
        view_zenith=ANGLES, view_azimuth=180.0, light_zenith=ANGLES, light_azimuth=0.0
    )
    said = scene.predict({"refractive_index": 1.5}, mirror)
    for name in ("q", "u"):
        np.testing.assert_allclose(capture[name], np.asarray(said[name]), atol=1e-5)
    assert capture.attrs["import_notes"].count("was assumed") == 2


def test_radians_are_read_as_said_and_refused_otherwise(write):
    psi, _ = psi_delta()
    degrees = pb.from_ellipsometer(write("a,P", ANGLES, psi), angle="a", psi="P")
    table = write("a,P", ANGLES, np.deg2rad(psi))
    with pytest.raises(CaptureError, match="looks like radians; say unit='radian'"):
        pb.from_ellipsometer(table, angle="a", psi="P")
    radians = pb.from_ellipsometer(table, angle="a", psi="P", unit="radian")
    np.testing.assert_allclose(radians["q"], degrees["q"], atol=1e-9)


@each("turned", [False, True])
def test_errors_are_those_of_many_readings(write, turned):
    """Also where psi is zero, at which q has no slope."""
    psi, delta = np.array([0.0, 20.0, 45.0]), np.array([180.0, 100.0, 0.0])
    angle = np.array([40.0, 50.0, 60.0])
    asked = {"delta": "D", "delta_error": 3.0} if turned else {}
    capture = pb.from_ellipsometer(
        write("a,P,D", angle, psi, delta), angle="a", psi="P", psi_error=2.0, **asked
    )
    random = np.random.default_rng(4)
    noise = np.deg2rad(random.normal(size=(2, 40_000, 3)) * [[[2.0]], [[3.0]]])
    # With delta, the error of psi counts twice in both: q and u together hold it once.
    psi, delta = np.deg2rad(psi) + noise[0] * np.sqrt(1 + turned), np.deg2rad(delta) + noise[1]
    drawn = {"q": np.cos(2.0 * psi)}
    if turned:
        drawn["u"] = np.sin(2.0 * psi) * np.cos(delta)
    for name, values in drawn.items():
        # Second order leaves terms of the fourth power of .05 radians; 40,000 draws add 1.8%.
        np.testing.assert_allclose(capture[f"{name}_error"], values.std(axis=0), rtol=0.05)


def test_wavelengths_are_columns_or_lines(write):
    red, blue = psi_delta(1.5)[0], psi_delta(1.52)[0]
    wide = pb.from_ellipsometer(
        write("a,P650,P450", ANGLES, red, blue),
        angle="a", psi=("P650", "P450"), wavelength=(650.0, 450.0),
    )  # fmt: skip
    waves = np.repeat([650.0, 450.0], ANGLES.size)
    lines = pb.from_ellipsometer(
        write("a,w,P", np.tile(ANGLES, 2), waves, np.append(red, blue)),
        angle="a", psi="P", wavelength="w",
    )  # fmt: skip
    assert wide["wavelength"].values.tolist() == [450.0, 650.0]
    np.testing.assert_array_equal(wide["q"], lines["q"])
    np.testing.assert_allclose(wide["q"].sel(wavelength=650.0), np.cos(2.0 * np.deg2rad(red)))


WVASE = (
    "glass, run 3\nVASEmethod[EllipsometerType=4]\nAngstroms\n"
    "E\t5000\t50\t10.1\t179.9\t0.05\t0.3\ndpolE\t5000\t50\t1.2\t0\t0\t0\n"
    "E\t5000\t60\t5.9\t0.2\t0.05\t0.3\nE\t6000\t50\t10.4\t179.9\t0.05\t0.3\n"
    "E\t6000\t60\t5.8\t0.2\t0.05\t0.3\ndpolE\t6000\t60\t1.2\t0\t0\t0\n"
)
ACCURION = (
    "#Lambda\tAOI\tPsi\tDelta\tTime\nnm\tdeg\tdeg\tdeg\ts\n"
    "658\t55\t27.7\t170.2\t1\n658\t60\t23.2\t166.3\t2\n"
)
HORIBA = (
    "# SAMPLE:\nx\n\n# INCIDENCE ANGLE:\n70.00°\n\n# DATA:\n"
    "nm Psi Delta\n500 12.1 140.2\n510 12.2 140.4\n"
)
NAMED = {"psi": "Psi", "delta": "Delta"}
MAKERS = {
    "WVASE": (WVASE, {}, {"view": 2, "wavelength": 2}, "2 lines of kind dpolE left out"),
    "Accurion": (
        ACCURION, {**NAMED, "angle": "AOI", "wavelength": "Lambda"}, {"view": 2}, "1 line of units",
    ),
    "Horiba": (
        HORIBA, {**NAMED, "angle": 70.0, "wavelength": "nm"}, {"view": 1, "wavelength": 2}, "above",
    ),
}  # fmt: skip


@each("maker", MAKERS)
def test_files_of_three_makers_are_read(tmp_path, maker):
    text, words, sizes, done = MAKERS[maker]
    (tmp_path / "e.dat").write_text(text)
    capture = pb.from_ellipsometer(tmp_path / "e.dat", **words)
    assert capture.sizes == sizes
    assert done in capture.attrs["import_notes"]
    assert float(np.max(capture["wavelength"])) in (600.0, 658.0, 510.0)
    first = {"WVASE": 10.1, "Accurion": 27.7, "Horiba": 12.1}[maker]
    assert capture["q"].values.ravel()[0] == pytest.approx(np.cos(2.0 * np.deg2rad(first)))


@each("kind", ["column", "row"])
def test_mueller_elements_give_q_of_either_sign_convention(write, kind):
    s, p = amplitudes(ANGLES)
    q = (s**2 - p**2) / (s**2 + p**2)
    name = "m21" if kind == "column" else "m12"
    for sign in (-1.0, 1.0):
        table = write(f"a,m11,{name},m33", ANGLES, 0.5 + 0 * q, 0.5 * sign * q, q)
        capture = pb.from_ellipsometer(table, angle="a", mueller=kind)
        np.testing.assert_allclose(capture["q"], q, atol=1e-9)
        assert ("s light counts as positive" in capture.attrs["import_notes"]) == (sign > 0.0)


REFUSED = [
    ({"angle": "a", "psi": "P", "unit": "gon"}, "unit: it is 'gon'; give degree or radian"),
    ({"angle": "a", "mueller": "m"}, "mueller: it is 'm'; give column or row"),
    ({"psi": "P"}, "angle: nothing gives the angle; give its column"),
    ({"angle": "a", "mueller": "row"}, "no column is an element of a matrix; name them m00"),
    ({"angle": "a", "psi": "x"}, "there is no column 'x'; choose from a, P, D"),
    ({"angle": "a", "psi": "D"}, "line 2: psi is 180, outside 0 to 90 degrees; check the column"),
    ({"angle": "a", "psi": ("P", "D")}, "wavelength: psi has 2 columns; give the wavelength of"),
    ({"angle": "a", "psi": "P", "delta": ("P", "D")}, "delta: there are 2 for 1 column of psi"),
    ({"angle": "a"}, "psi is not named, and 3 columns are no .dat file of WVASE; name psi="),
]


@each(("asked", "said"), REFUSED)
def test_what_is_wrong_is_named(write, asked, said):
    table = write("a,P,D", ANGLES, *psi_delta())
    with pytest.raises(CaptureError, match=re.escape(said)) as caught:
        pb.from_ellipsometer(table, **asked)
    assert str(caught.value).isprintable()


@pytest.mark.thorough
def test_a_thin_film_is_found_from_psi_and_delta(write):
    """A film of index 1.8 and 120 nm on glass of 1.5, at three wavelengths; noise as assumed."""
    waves, angle = np.array([450.0, 550.0, 650.0]), np.arange(40.0, 76.0, 3.0)
    light = pb.physics.LinearPolarization(angle=-45.0)
    optics = {"surface": pb.SmoothSurface(beam=pb.PointSource(light))}
    lit = pb.Scene(**optics, coat=pb.ThinFilm(1.8, 120.0))
    psi, delta = [], []
    random = np.random.default_rng(6)
    for wave in waves:
        mirror = pb.Geometry.from_degrees(
            view_zenith=angle, view_azimuth=180.0, light_zenith=angle, light_azimuth=0.0,
            wavelength=wave,
        )  # fmt: skip
        said = lit.predict({"refractive_index": 1.5}, mirror)
        q, u = (np.asarray(said[name], float) for name in ("q", "u"))
        phase = np.arccos(np.clip(u / np.sqrt(1.0 - q**2), -1.0, 1.0))
        psi.append(0.5 * np.rad2deg(np.arccos(q)) + 0.1 * random.normal(size=angle.size))
        delta.append(np.rad2deg(phase) + 0.2 * random.normal(size=angle.size))
    columns = np.tile(angle, 3), np.repeat(waves, angle.size), np.ravel(psi), np.ravel(delta)
    capture = pb.from_ellipsometer(
        write("a,w,P,D", *columns), angle="a", wavelength="w", psi="P", delta="D"
    )
    scene = pb.Scene(
        pb.SmoothSurface(), coat=pb.ThinFilm("film_refractive_index", "film_thickness")
    )
    own = {"film_refractive_index": dist.Uniform(1.3, 2.0)}
    table = pb.summary(pb.fit(capture, scene=scene, priors=own, method="laplace"))
    for name, truth in (("film_refractive_index", 1.8), ("film_thickness", 120.0)):
        row = table.loc[name]
        assert abs(row["mean"] - truth) < 3.3 * row["sd"]
    assert table.loc["film_thickness", "sd"] < 2.0
