"""Goniometer readings as captures: the arithmetic, the honest gaps, and every refusal."""

import re

import numpy as np
import pytest
import xarray as xr
from cases import each
from textbook import mirror_and_body

from polar_bayes.capture import inferred, stated
from polar_bayes.capture.files import load_capture, save_capture
from polar_bayes.capture.schema import count, validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.goniometer import from_goniometer

ANGLES = np.arange(20.0, 81.0, 5.0)
GLASS = 1.5


def fresnel(angle, index=GLASS):
    """s and p reflectance of a smooth surface, by the textbook."""
    return mirror_and_body(index, np.deg2rad(angle))[:2]


def readings(full=1000.0, dark=0.0, angles=ANGLES):
    """Return detector readings of s and p, to two decimals."""
    return [(angles, np.round(dark + full * light, 2)) for light in fresnel(angles)]


def test_one_view_for_each_angle_in_the_mirror_direction():
    s, p = readings()
    capture = from_goniometer(s, p, wavelength=633.0, name="glass")
    np.testing.assert_array_equal(capture["view_zenith"], ANGLES)
    np.testing.assert_array_equal(capture["light_zenith"], ANGLES)
    assert set(capture["view_azimuth"].values) == {180.0}
    assert set(capture["light_azimuth"].values) == {0.0}
    assert capture["wavelength"].item() == 633.0
    assert count(capture) == {"views": ANGLES.size, "masked": 0, "saturated": 0}
    assert not capture["interpolated"].any()
    xr.testing.assert_identical(validate(capture), capture)


def test_q_is_positive_for_s_light_and_intensity_is_the_mean():
    s, p = readings()
    capture = from_goniometer(s, p)
    S, P = fresnel(ANGLES)
    np.testing.assert_allclose(capture["q"], (S - P) / (S + P), atol=2e-4)
    np.testing.assert_array_equal(capture["dop"], np.abs(capture["q"]))
    np.testing.assert_allclose(capture["intensity"], 500.0 * (S + P), atol=0.01)
    assert capture["q"].min() > 0.0


def test_swapped_s_and_p_are_refused(tmp_path):
    s, p = readings(full=90.0)
    table = tmp_path / "plate.csv"
    rows = (f"{a},{x},{y}" for a, x, y in zip(ANGLES, s[1], p[1], strict=True))
    table.write_text("\n".join(["angle,I_s,I_p", *rows]))
    for swapped in (
        {"s": p, "p": s, "name": "plate"},
        {"table": table, "angle": "angle", "s": "I_p", "p": "I_s"},
    ):
        with pytest.raises(CaptureError, match="plate: s lies below p at 13 of 13 ang") as caught:
            from_goniometer(**swapped)
        assert "swap s= and p=, or give s_incident= and p_incident=" in caught.value.hint


@each("ratio", [0.5, 1.0, 2.0])
def test_channels_of_unequal_gain_are_not_swapped(ratio):
    """Near Brewster's angle s exceeds p whatever the gains."""
    s, (angles, p) = readings()
    capture = from_goniometer(s, (angles, ratio * p))
    assert capture["q"].max() > 0.9


@pytest.mark.thorough
def test_incident_levels_put_the_channels_on_one_scale():
    (_, S), (_, P) = readings()
    plain = from_goniometer((ANGLES, S), (ANGLES, P))
    s, p = (ANGLES, 3.0 * S + 7.0), (ANGLES, 0.5 * P + 7.0)
    capture = from_goniometer(s, p, s_incident=3007.0, p_incident=507.0, dark_level=7.0)
    np.testing.assert_allclose(capture["q"], plain["q"], rtol=1e-12)
    np.testing.assert_allclose(capture["intensity"], plain["intensity"] / 1000.0, rtol=1e-12)
    assert capture["intensity"].attrs["units"] == capture["intensity_error"].attrs["units"] == "1"
    assert plain["intensity"].attrs["units"] == "arbitrary"


def test_attributes_tell_how_it_was_measured(tmp_path):
    s, p = readings()
    options = {"s_incident": 1000.0, "p_incident": 1000.0, "p_error": 0.5, "relative_error": 0.02}
    capture = from_goniometer(s, p, name="plate", **options)
    expected = {
        "name": "plate",
        "source": "arrays",
        "setup": "goniometer",
        "incident_levels": "given",
        "angle_set_by": "hand",
        "dark_level": 0.0,
        "readings_at_zero": 0,
    }
    assert capture.attrs == expected | options
    save_capture(capture, tmp_path / "plate.nc")
    xr.testing.assert_identical(load_capture(tmp_path / "plate.nc"), capture)


@each(
    ("asked", "said"),
    [
        ({}, "errors assumed by the import"),
        ({"s_error": 0.5, "p_error": 0.5}, "errors assumed by the import"),
        ({"relative_error": 0.01}, "errors stated"),
    ],
)
def test_errors_that_nobody_stated_are_said_to_be_assumed(asked, said):
    capture = from_goniometer(*readings(), **asked)
    assert f"q ({said})" in inferred(capture)[0]
    (note, *_) = stated(capture)
    assert ("1% of each reading of s and p was assumed" in note) == ("assumed" in said)


def test_errors_from_repeats_or_cells_are_not_assumed(tmp_path):
    s, p = ((np.repeat(x, 2), np.repeat(y, 2) + [0.0, 0.01] * x.size) for x, y in readings())
    assert "q (errors from the scatter of repeats)" in inferred(from_goniometer(s, p))[0]
    table = tmp_path / "plate.csv"
    table.write_text("angle,s,p\n40,10.0(1),5.0(1)\n50,20.0(1),1.2(1)\n")
    capture = from_goniometer(table=table, angle="angle", s="s", p="p")
    assert "q (errors stated)" in inferred(capture)[0]


def test_errors_follow_from_the_channels_by_monte_carlo():
    s, p = (ANGLES, 100.0 * np.ones(ANGLES.size)), (ANGLES, np.linspace(0.0, 150.0, ANGLES.size))
    capture = from_goniometer(s, p, s_error=0.5, p_error=0.3, relative_error=0.01)
    random = np.random.default_rng(3)
    S, P = (
        values + np.hypot(0.01 * values, error) * random.normal(size=(40_000, ANGLES.size))
        for (_, values), error in ((s, 0.5), (p, 0.3))
    )
    # A standard deviation from 40,000 draws is known to 1 / sqrt(80,000) = .35 %: five of these.
    np.testing.assert_allclose(capture["q_error"], np.std((S - P) / (S + P), axis=0), rtol=0.018)
    np.testing.assert_allclose(capture["intensity_error"], np.std((S + P) / 2, axis=0), rtol=0.018)
    np.testing.assert_array_equal(capture["dop_error"], capture["q_error"])


@pytest.mark.thorough
def test_the_resolution_is_that_of_the_printed_digits(tmp_path):
    table = tmp_path / "plate.csv"
    table.write_text("angle,s,p\n40,10.0,5\n50,20,1.25\n")
    capture = from_goniometer(table=table, angle="angle", s="s", p="p", relative_error=0.0)
    S_error, P_error = np.array([[0.1, 1.0], [1.0, 0.01]]) / np.sqrt(12.0)
    np.testing.assert_allclose(capture["intensity_error"], np.hypot(S_error, P_error) / 2.0)
    arrays = from_goniometer(([40, 50], [10.5, 20]), ([40, 50], [5, 1]), relative_error=0.0)
    expected = np.hypot(0.1, 1.0) / np.sqrt(12.0) / 2.0  # the finest digit of each channel
    np.testing.assert_allclose(arrays["intensity_error"], [expected, expected])


def test_columns_files_and_arrays_give_the_same_capture(tmp_path):
    (_, S), (_, P) = readings()
    for name, values in (("s", S), ("p", P)):
        rows = "".join(f"{a}\t{v:.2f}\n" for a, v in zip(ANGLES, values, strict=True))
        (tmp_path / f"{name}.txt").write_text(rows)
    rows = "".join(f"{a};{s:.2f};{p:.2f}\n" for a, s, p in zip(ANGLES, S, P, strict=True))
    (tmp_path / "both.csv").write_text("angle;I_s;I_p\n" + rows)
    arrays = from_goniometer((ANGLES, S), (ANGLES, P))
    files = from_goniometer(tmp_path / "s.txt", str(tmp_path / "p.txt"))
    columns = from_goniometer(table=tmp_path / "both.csv", angle="angle", s="I_s", p="I_p")
    for capture in (files, columns):
        xr.testing.assert_allclose(capture, arrays)
    assert (files.attrs["name"], files.attrs["source"]) == ("s, p", "s.txt, p.txt")
    assert (columns.attrs["name"], columns.attrs["source"]) == ("both", "both.csv")


@pytest.mark.thorough
def test_the_order_of_the_rows_does_not_matter():
    s, p = readings()
    order = np.random.default_rng(0).permutation(ANGLES.size)
    shuffled = from_goniometer((ANGLES[order], s[1][order]), p)
    xr.testing.assert_identical(shuffled, from_goniometer(s, p))


# --- angles at which one channel alone was read -----------------------------------------------


def test_a_missing_reading_is_interpolated_within_its_error():
    fine = np.arange(20.0, 81.0, 1.0)
    s, p = readings()[0], readings(angles=fine)[1]
    capture = from_goniometer(s, p, relative_error=0.001)
    S, P = fresnel(fine)
    between = ~np.isin(fine, ANGLES)
    np.testing.assert_array_equal(capture["interpolated"], between)
    assert capture["valid"].all()
    deviation = np.abs(capture["q"] - (S - P) / (S + P)) / capture["q_error"]
    assert deviation.max() < 3.0
    brightness = np.abs(capture["intensity"] - 500.0 * (S + P)) / capture["intensity_error"]
    assert brightness.max() < 3.0


@pytest.mark.thorough
def test_interpolation_across_the_dark_angle_is_not_trusted():
    """Between readings beside Brewster's angle no curve finds the dip: the error must say so."""
    fine = np.arange(20.0, 81.0, 1.0)
    capture = from_goniometer(readings(angles=fine)[0], readings()[1], relative_error=0.001)
    S, P = fresnel(fine)
    deviation = np.abs(capture["q"] - (S - P) / (S + P)) / capture["q_error"]
    assert deviation.max() < 3.0


@pytest.mark.thorough
def test_interpolation_stays_between_its_neighbors():
    s = (np.array([10.0, 20.0, 30.0, 40.0]), np.array([1.0, 1.0, 9.0, 9.0]))
    p = (np.arange(10.0, 41.0, 2.0), np.ones(16))
    S = 2.0 * from_goniometer(s, p)["intensity"] - 1.0
    assert float(S.min()) >= 1.0 - 1e-12
    assert float(S.max()) <= 9.0 + 1e-12


@pytest.mark.thorough
def test_nothing_is_made_up_outside_the_range_of_a_channel():
    s, p = (np.array([30.0, 50.0]), np.array([4.0, 8.0])), (np.array([20.0, 40.0]), np.ones(2))
    capture = from_goniometer(s, p)
    np.testing.assert_array_equal(capture["view_zenith"], [20.0, 30.0, 40.0, 50.0])
    np.testing.assert_array_equal(capture["valid"], [False, True, True, False])
    np.testing.assert_array_equal(capture["interpolated"], [False, True, True, False])
    for name in ("dop", "q", "intensity", "dop_error", "q_error", "intensity_error"):
        np.testing.assert_array_equal(np.isnan(capture[name]), ~capture["valid"])
    assert count(capture)["masked"] == 2
    assert float(capture["intensity"][2]) == pytest.approx((np.sqrt(32.0) + 1.0) / 2.0)


@pytest.mark.thorough
def test_angles_that_print_alike_are_one_angle():
    grid = np.arange(20.0, 80.0, 0.1)
    capture = from_goniometer((grid, grid), (np.linspace(20.0, 79.9, 600), grid))
    assert capture.sizes["view"] == 600
    assert not capture["interpolated"].any()


# --- no light ---------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_reading_a_little_below_the_dark_level_is_no_light():
    angles = np.array([50.0, 55.0, 60.0])
    s, p = (angles, np.array([30.0, 40.0, 50.0])), (angles, np.array([2.0, 0.9, 3.0]))
    capture = from_goniometer(s, p, dark_level=1.0, p_error=0.05)
    assert float(capture["q"][1]) == float(capture["dop"][1]) == 1.0
    assert float(capture["q_error"][1]) == pytest.approx(2.0 * 0.05 / 39.0)
    assert capture.attrs["readings_at_zero"] == 1
    with pytest.raises(CaptureError, match=r"p\[row=1\]: the reading lies below the dark level 1"):
        from_goniometer(s, p, dark_level=1.0, p_error=0.03)


def test_a_view_without_any_light_is_masked():
    angles = np.array([50.0, 55.0])
    capture = from_goniometer((angles, [0.0, 3.0]), (angles, [0.0, 1.0]))
    np.testing.assert_array_equal(capture["valid"], [False, True])
    assert np.isnan(capture["q"][0])


@pytest.mark.thorough
def test_interpolation_between_readings_of_no_light_stays_finite():
    s = (np.arange(50.0, 60.0), np.ones(10))
    capture = from_goniometer(s, (np.array([50.0, 54.0, 59.0]), np.array([1.0, 0.0, 2.0])))
    assert capture["valid"].all()
    assert np.isfinite(capture["q_error"]).all()


def test_a_reading_of_zero_is_as_uncertain_as_its_neighbors_scatter():
    """A program that cuts off at zero prints a zero whose last digit says nothing of the noise."""
    noise = 0.4 * np.random.default_rng(2).normal(size=ANGLES.size)
    s, p = readings(full=100.0)
    cut = np.maximum(p[1] + noise, 0.0).round(6)
    cut[7] = 0.0  # at Brewster's angle
    capture = from_goniometer(s, (ANGLES, cut))
    at_zero = float(capture["q_error"][7] * 2.0 * capture["intensity"][7] / 2.0)
    # The scatter of six neighbors around a parabola has three degrees of freedom.
    assert 0.1 < at_zero < 1.5
    assert "1 reading of p at zero or below given the scatter" in capture.attrs["import_notes"]
    stated = from_goniometer(s, (ANGLES, cut), p_error=1e-3)
    assert float(stated["q_error"][7]) < 1e-2 * float(capture["q_error"][7])


# --- refusals ---------------------------------------------------------------------------------

GOOD = ([40.0, 50.0], [2.0, 3.0])
OPTIONS = [
    ({}, "goniometer: no channel is there", "give s= and p=, or one of s="),
    (
        {"s": GOOD, "unpolarized": GOOD},
        "unpolarized light is a channel alone",
        "give s= and p=, or",
    ),
    ({"s": GOOD, "p_error": 1.0}, "p_error: its channel is missing", "give p=, or leave it out"),
    ({"s": GOOD, "angle_is": "theta"}, "angle_is: it is 'theta'", "give one of incidence, from-s"),
    ({"s": GOOD, "p": GOOD, "angle": "a"}, "angle: a column is named without table", "give table="),
    ({"table": "t.csv", "s": "S", "p": "P"}, "t.csv: angle: its column is not named", "by angle="),
    ({"table": "t.csv", "angle": "a", "s": GOOD, "p": "P"}, "t.csv: s: its column", "table by s="),
    ({"table": "t.csv", "angle": "a", "p": GOOD}, "t.csv: p: its column is", "table by p="),
    ({"table": "t.csv", "angle": "a", "s": "S", "p": "P"}, "t.csv: there is no such", "check the"),
    ({"s": "gone.txt", "p": GOOD}, "gone.txt: there is no such file", "check the path"),
    ({"s": GOOD, "p": GOOD, "s_incident": 9.0}, "one incident level is missing", "or neither"),
    ({"s": GOOD, "p": GOOD, "s_incident": 0.0, "p_incident": 1.0}, "s_incident: it is 0", "0 < va"),
    ({"s": GOOD, "p": GOOD, "s_incident": 9, "p_incident": np.nan}, "p_incident: it is nan", "0 <"),
    ({"s": GOOD, "p": GOOD, "s_error": 0.0}, "s_error: it is 0.0", "give 1e-30 <= value"),
    ({"s": GOOD, "p": GOOD, "p_error": np.inf}, "p_error: it is inf", "give 1e-30 <= value"),
    ({"s": GOOD, "p": GOOD, "relative_error": -0.1}, "relative_error: it is -0.1", "0 <= value"),
    ({"s": GOOD, "p": GOOD, "relative_error": "1%"}, "relative_error: it is '1%'", "value < 1"),
    ({"s": GOOD, "p": GOOD, "dark_level": np.nan}, "dark_level: it is nan", "value < 1e+30"),
    ({"s": GOOD, "p": GOOD, "dark_level": 10**400}, "dark_level: it is 1000", "value < 1e+30"),
    ({"s": GOOD, "p": GOOD, "wavelength": 0.0}, "wavelength: it is 0.0", "give 0 < value"),
    ({"s": GOOD, "p": GOOD, "wavelength": [1.0]}, "wavelength: it is [1.0]", "give 0 < value"),
    ({"s": 3, "p": GOOD}, "s: it is neither table nor pair", "give a path or a pair"),
    ({"s": GOOD, "p": [1, 2, 3]}, "p: it is neither table nor pair", "give a path or a pair"),
    ({"s": ([1.0], ["a"]), "p": GOOD}, "s: it holds more than a list of numbers", "one finite num"),
    ({"s": GOOD, "p": ([1.0], [np.nan])}, "p: it holds more than a list of", "one finite number"),
    ({"s": GOOD, "p": (np.ones((2, 2)), np.ones((2, 2)))}, "p: it holds more than", "one finite"),
    ({"s": ([1, 2], [1]), "p": GOOD}, "s: 2 angles and 1 readings", "one angle for each reading"),
    ({"s": ([], []), "p": GOOD}, "s: it holds|s: 0 angles", "one"),
    ({"s": ([40, 90], [1, 2]), "p": GOOD}, "s[row=1]: the angle is outside 0 <= value <", "surf"),
    ({"s": GOOD, "p": ([-1, 50], [1, 2])}, "p[row=0]: the angle is outside", "'incidence' takes"),
    ({"s": ([99, 20, 30], [9, 1, 2])}, "s[row=0]: the angle is outside", "angle_is='two-theta'"),
    (
        {"s": ([20, 99], [1, 9]), "angle_is": "from-surface"},
        "s[row=1]: the angle",
        "check angle_is",
    ),
    ({"s": ([40, 50], [1, 1e31]), "p": GOOD}, "s[row=1]: the reading is too large", "below 1e+30"),
    ({"s": ([40, 50], [1, -9]), "p": GOOD}, "s[row=1]: the reading lies below the", "by s_err"),
    (
        {"s": GOOD, "p": GOOD, "s_incident": 2.4, "p_incident": 9.0},
        "s[row=1]: more light comes back than went in (angle 50, s 3)",
        "check s_incident=, which is 2.4",
    ),
    ({"s": GOOD, "p": ([10, 20], [1, 2])}, "s and p share no angle", "over the same range"),
]


@each(("options", "what", "hint"), OPTIONS)
def test_what_is_wrong_is_named_with_its_mend(options, what, hint):
    pattern = "|".join(map(re.escape, what.split("|")))
    with pytest.raises(CaptureError, match=pattern) as caught:
        from_goniometer(**options)
    assert hint in caught.value.hint
    assert "\n" not in str(caught.value)


def test_a_wrong_line_of_a_table_is_named(tmp_path):
    path = tmp_path / "s.txt"
    path.write_text("# angle, reading\n40, 2\n95, 3\n")
    with pytest.raises(CaptureError, match=r"s\.txt: line 3: the angle is outside .*normal"):
        from_goniometer(path, GOOD)
    path.write_text("40 2 1\n50 3 1\n")
    with pytest.raises(CaptureError, match=r"it has 3 columns, not two; .* use table= and name"):
        from_goniometer(path, GOOD)
    with pytest.raises(CaptureError, match=r"no column 'S'; choose from column_1, column_2, col"):
        from_goniometer(table=path, angle="column_1", s="S", p="column_3")


# --- what others measured ---------------------------------------------------------------------


def test_measured_glass_is_close_to_fresnel(measured):
    folder = measured / "glass_fresnel"
    capture = from_goniometer(
        folder / "s1.txt", folder / "p1.txt", s_incident=1910, p_incident=1630, wavelength=633
    )
    assert count(capture) == {"views": 39, "masked": 0, "saturated": 0}
    assert int(capture["interpolated"].sum()) == 24
    S, P = fresnel(capture["view_zenith"].values, 1.509)
    deviation = np.abs(capture["q"] - (S - P) / (S + P))
    # Systematic errors dominate: the detector sees some s as p.
    assert float(deviation.max()) < 0.06


@pytest.mark.thorough
def test_measured_plexiglas_is_close_to_fresnel(measured):
    table = measured / "plexiglas_fresnel" / "plexiglas_A.csv"
    capture = from_goniometer(table=table, angle="angle_deg", s="I_s_uA", p="I_p_uA")
    assert capture.sizes["view"] == 15
    S, P = fresnel(capture["view_zenith"].values, 1.489)
    assert float(np.abs(capture["q"] - (S - P) / (S + P)).max()) < 0.1
    assert capture.attrs["incident_levels"] == "not given"
