"""Frames behind a polarizer as captures: the same light as the scene's, in the model's plane."""

import dataclasses
import re

import numpy as np
import pictures
import pytest
from cases import each
from pictures import BALL, FOUR, FULL, LAMP, QUIET, frames, predicted
from PIL import Image

import polar_bayes as pb
from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.images import from_polarizer

NORMALS = pictures.ball_normals()
KNOWN = {"shape": NORMALS, "light": LAMP, "detector": QUIET, "window": 1}
REASONS = ("outside", "turned_away", "in_shadow", "saturated", "too_dark", "overpolarized")


def imported(taken=None, angles=FOUR, **asked):
    """The capture of frames, by default those of the ball without noise."""
    return from_polarizer(frames(angles) if taken is None else taken, angles, **KNOWN | asked)


def check_same_light(capture):
    """The capture holds what the scene predicts, up to one exposure for all."""
    valid = capture["valid"].values
    said = predicted(capture, valid)
    for name in ("q", "u"):
        np.testing.assert_allclose(capture[name].values[valid], said[name], atol=1e-6)
    ratio = capture["intensity"].values[valid] / said["intensity"]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)
    assert valid.sum() > 700  # of 960 pixels of the ball


@each(
    "angles",
    [
        FOUR,
        (0.0, 60.0, 120.0),
        (0.0, 20.0, 75.0),
        (-30.0, 10.0, 50.0, 100.0, 250.0),
    ],
)
def test_light_of_a_scene_comes_back_in_the_plane_of_the_model(angles):
    """Signs and frame of q and u, for any set of angles, by two ways that share no formula."""
    capture = imported(angles=angles)
    check_same_light(capture)
    # Both signs of both are there, so that none can be confused.
    for name in ("q", "u"):
        assert capture[name].min() < -0.02
        assert capture[name].max() > 0.02


def test_a_wrong_sense_of_the_angles_does_not_pass():
    """The test above can fail: a scale that counts clockwise gives other light."""
    clockwise = [-angle for angle in FOUR]
    capture = imported(frames(clockwise))
    with pytest.raises(AssertionError):
        check_same_light(capture)


@pytest.mark.thorough
def test_light_and_camera_may_stand_near():
    """Off the axis the lens turns the camera's axes with each ray."""
    camera, lamp = pb.importers.Position(3.0, -2.0, 60.0), pb.importers.Position(-30.0, 50.0, 45.0)
    view, light = pictures.near((3.0, -2.0, 60.0)), pictures.near((-30.0, 50.0, 45.0))
    capture = imported(frames(FOUR, view=view, light=light), light=lamp, view=camera)
    valid = capture["valid"].values
    assert valid.sum() > 500
    said = predicted(capture, valid)
    for name in ("q", "u"):
        np.testing.assert_allclose(capture[name].values[valid], said[name], atol=1e-6)


def test_a_sphere_is_its_normals():
    by_map, by_sphere = imported(), imported(shape=BALL)
    both = by_map["valid"].values & by_sphere["valid"].values
    assert both.sum() == by_sphere["valid"].sum() > 500
    for name in ("q", "u", "view_zenith", "light_zenith"):
        np.testing.assert_allclose(by_map[name].values[both], by_sphere[name].values[both])


def test_a_highlight_tells_the_direction_of_the_light():
    half = pictures.unit(np.array([LAMP.x, LAMP.y, LAMP.z]))
    half = pictures.unit(half + np.array([0.0, 0.0, 1.0]))
    spot = pb.importers.Highlight(
        BALL.row - BALL.radius * half[1], BALL.column + BALL.radius * half[0]
    )
    told, stated = imported(shape=BALL, light=spot), imported(shape=BALL)
    np.testing.assert_allclose(told["light_zenith"], stated["light_zenith"], atol=1e-9)
    assert "Highlight" in told.attrs["light"]
    assert "Direction" in told.attrs["light"]


def test_surroundings_stand_where_each_place_mirrors_them():
    capture = imported(shape=BALL, light=pb.importers.Surroundings())
    assert capture.attrs["masked_in_shadow"] == 0
    np.testing.assert_allclose(capture["light_zenith"], capture["view_zenith"], atol=1e-6)
    np.testing.assert_allclose(np.abs(capture["view_azimuth"]), 180.0)
    lamp = imported(shape=BALL)
    both = lamp["valid"].values & capture["valid"].values
    np.testing.assert_array_equal(capture["q"].values[both], lamp["q"].values[both])


@pytest.mark.thorough
def test_views_of_a_window_are_the_readings_next_to_each_other():
    one, four = imported(), imported(window=2)
    assert dict(four.sizes) == {"y": 20, "x": 24, "view": 4}
    np.testing.assert_array_equal(four["q"].isel(y=9, x=12), one["q"].values[18:20, 24:26].ravel())
    assert four["y"].values[:2].tolist() == [0.5, 2.5]


@pytest.mark.thorough
def test_what_fills_no_square_is_counted():
    capture = imported(bin=3, window=3)
    assert capture.attrs["left_over_rows"] == 40 % 9
    assert capture.attrs["left_over_columns"] == 48 % 9
    assert dict(capture.sizes) == {"y": 4, "x": 5, "view": 9}


def test_dark_and_flat_frames_are_taken_out():
    rng = np.random.default_rng(0)
    dark = rng.uniform(5.0, 20.0, pictures.SHAPE)
    flat = rng.uniform(0.5, 1.5, pictures.SHAPE)
    flat /= flat.mean()
    raw = frames(FOUR) * flat + dark
    mended = imported(raw, detector=dataclasses.replace(QUIET, dark=dark, flat=7.0 * flat))
    clean, spoiled = imported(), imported(raw)
    both = mended["valid"].values & clean["valid"].values
    assert both.sum() > 600
    np.testing.assert_allclose(mended["q"].values[both], clean["q"].values[both], atol=1e-9)
    assert np.nanmax(np.abs(spoiled["q"] - clean["q"])) > 0.05


@pytest.mark.thorough
def test_every_masked_reading_has_one_reason():
    raw = frames(FOUR)
    lamp = pb.importers.Direction(1.0, 0.0, 0.2)  # from the side: a part is in its own shadow
    raw[0, 18:20, 24:26] = FULL  # one channel is full: the quotient is spoiled
    raw[:, 10, 24] = 0.0
    raw[0, 25, 24] = raw[0, 25, 24] + 300.0  # more than light can have
    raw[2, 25, 24] = 0.0
    normals = NORMALS.copy()
    normals[12, 24] = [0.6, 0.0, -0.8]
    capture = imported(raw, shape=normals, light=lamp)
    with_counter = {reason: capture.attrs[f"masked_{reason}"] for reason in REASONS}
    assert sum(with_counter.values()) == int((~capture["valid"]).sum())
    assert with_counter["outside"] == np.isnan(NORMALS).any(-1).sum()
    assert with_counter["turned_away"] == 1
    assert with_counter["in_shadow"] > 50
    assert with_counter["saturated"] == 4
    assert with_counter["too_dark"] >= 1
    assert with_counter["overpolarized"] == 1
    assert pb.capture.count(capture)["saturated"] == 4
    assert not capture["valid"].values[18:20, 24:26].any()
    assert np.isnan(capture["q"].where(~capture["valid"])).all()


@pytest.mark.thorough
def test_errors_are_those_of_many_exposures():
    """Scores of q and u of 6,000 readings with three unequal angles, whose errors go together.

    Noise is drawn as the detector states it. Mean squares lie within five standard errors
    (sqrt(2/6000)) of one, so one run in a million fails by chance; so does the correlation.
    """
    rng = np.random.default_rng(3)
    angles, gain, read_noise = (0.0, 20.0, 75.0), 0.5, 4.0
    shape = (60, 100)
    normals = pictures.even((0.3, 0.5, 0.8), shape)
    clean = frames(angles, normals=normals)
    variance = read_noise**2 + gain * clean
    raw = np.rint(clean + np.sqrt(variance) * rng.normal(size=clean.shape))
    detector = dataclasses.replace(QUIET, gain=gain, read_noise=read_noise)
    capture = imported(raw, angles, shape=normals, detector=detector)
    assert capture["valid"].all()
    said = predicted(capture)
    scores = {
        name: ((capture[name] - said[name]) / capture[f"{name}_error"]).values.ravel()
        for name in ("q", "u")
    }
    for name, score in scores.items():
        assert abs(np.mean(score)) < 5.0 / np.sqrt(score.size), name
        assert abs(np.mean(score**2) - 1.0) < 5.0 * np.sqrt(2.0 / score.size), name
    together = np.mean(scores["q"] * scores["u"])
    assert abs(together) > 0.3
    stated = capture.attrs["largest_correlation_of_q_and_u"]
    assert abs(abs(together) - stated) < 5.0 / np.sqrt(scores["q"].size) + 0.02
    assert "median_misfit" not in capture.attrs


@pytest.mark.thorough
def test_averaging_pixels_lowers_the_noise_but_not_what_stays_unknown():
    for detector, ratio in (
        (dataclasses.replace(QUIET, read_noise=20.0, gain=0.0001), 0.5),
        (dataclasses.replace(QUIET, gain=1e-9, relative_error=0.05), 1.0),
    ):
        fine, coarse = (imported(bin=width, detector=detector) for width in (1, 2))
        left = coarse["q_error"].isel(y=9, x=12) / fine["q_error"].isel(y=18, x=24)
        np.testing.assert_allclose(left, ratio, rtol=0.1)


@each("suffix", [".png", ".tif", ".npy"])
def test_files_hold_the_same_as_arrays(tmp_path, suffix):
    raw = np.rint(frames(FOUR)).astype(np.uint16)
    paths = [tmp_path / f"ball{angle:.0f}{suffix}" for angle in FOUR]
    for path, frame in zip(paths, raw, strict=True):
        np.save(path, frame) if suffix == ".npy" else Image.fromarray(frame).save(path)
    np.save(tmp_path / "normals.npy", NORMALS)
    files = imported(paths, shape=tmp_path / "normals.npy", wavelength=550.0)
    arrays = imported(raw, name="ball0", wavelength=550.0)
    assert files.attrs["name"] == "ball0"
    assert files.attrs["source"] == ", ".join(path.name for path in paths)
    assert str(tmp_path) not in str(files.attrs)
    assert files.drop_attrs().equals(arrays.drop_attrs())
    assert files["wavelength"].item() == 550.0
    assert validate(files).identical(files)


@pytest.mark.thorough
def test_frames_of_8_bits_are_full_at_255():
    raw = np.rint(frames(FOUR, full=400.0))
    raw[1, 15, 24] = 255.0
    capture = imported(list(raw.astype(np.uint8)), shape=BALL, detector=None, window=2)
    assert capture.attrs["saturation_level"] == 255.0
    assert capture.attrs["gain_is"] == "assumed"
    assert capture.attrs["masked_saturated"] == 1
    assert capture.attrs["median_misfit"] < 3.0


EVEN = np.full((4, *pictures.SHAPE), 300.0)


def detected(**field):
    return {"detector": pb.importers.Detector(saturation_level=FULL, **field)}


@each(
    ("asked", "said"),
    [
        ({"angles": (0, 90, 180, 270)}, "the polarizer stood at 2 different angles"),
        ({"angles": (0, 1, 2, 3)}, "are so close that noise grows"),
        ({"angles": (0, 45, 90)}, "there are 4 frames and 3 angles; give one frame for each"),
        ({"angles": "abc"}, "angles: 'abc' are no angles"),
        ({"taken": "a.png"}, "frames: a str is no list"),
        ({"taken": [*np.ones((3, 40, 48)), np.ones((3, 3))]}, "frames[3]: it is (3, 3), the fi"),
        ({"taken": np.ones((4, 40, 48, 3))}, "frames[0]: it holds float64 of shape (40, 48, 3)"),
        ({"taken": np.full((4, 40, 48), np.nan)}, "frames[0][row=0, column=0]: nan is no reading"),
        ({"taken": ["no.png"] * 4}, "no.png: there is no such file"),
        ({"detector": None}, "saturation_level: the frames do not say"),
        ({"shape": np.ones((40, 48))}, "normals: it holds float64 of shape (40, 48)"),
        ({"shape": 2.0 * NORMALS}, "its length is 2"),
        ({"shape": NORMALS[:-1]}, "normals: they are (39, 48), the frames (40, 48)"),
        ({"shape": 3.0}, "shape: a float is no shape"),
        ({"shape": ()}, "Spheres: there is no sphere"),
        ({"shape": pb.importers.Sphere(400.0, 10.0, 20.0)}, "it lies outside of frames of 40 rows"),
        ({"light": "sun"}, "light: 'sun' is neither direction nor position"),
        ({"light": pb.importers.Highlight(2.0, 2.0)}, "there is no surface; give row and column"),
        ({"light": pb.importers.Direction(0.0, 0.0, -1.0)}, "no reading is left"),
        ({"view": 3}, "view: 3 is neither direction nor position"),
        ({"bin": 0}, "bin: it is 0; give a whole number"),
        ({"window": 1.5}, "window: it is 1.5"),
        ({"bin": 30, "window": 2}, "hold no square of 60 pixels"),
        ({"wavelength": -5.0}, "wavelength: it is -5.0"),
        (detected(dark=np.ones((2, 2))), "dark: it is (2, 2), the frames are (40, 48)"),
        (detected(dark=2000.0), "dark: it reaches the full count 1000"),
        (detected(flat=np.eye(40, 48)), "is less than a twentieth of its mean"),
    ],
)
def test_a_mistake_is_told_with_its_mend(asked, said):
    with pytest.raises(CaptureError, match=re.escape(said)):
        imported(**{"taken": EVEN} | asked)


@each(
    ("field", "said"),
    [
        ({"gain": 0.0}, "gain: it is 0.0; give 0 < value"),
        ({"read_noise": -1.0}, "read_noise: it is -1.0"),
        ({"relative_error": 1.0}, "relative_error: it is 1.0"),
        ({"saturation_level": "full"}, "saturation_level: it is 'full'"),
    ],
)
def test_a_detector_is_checked(field, said):
    with pytest.raises(CaptureError, match=re.escape(said)):
        pb.importers.Detector(**field)


@pytest.mark.thorough
def test_files_that_hold_something_else_than_one_frame_of_counts_are_refused(tmp_path, monkeypatch):
    pages = [Image.fromarray(np.full((8, 8), 100 + k, np.uint8)) for k in range(4)]
    pages[0].save(tmp_path / "angles.tif", save_all=True, append_images=pages[1:])
    pages[0].save(tmp_path / "ball.jpg")
    pages[0].save(tmp_path / "large.png")
    Image.new("RGB", (48, 40)).save(tmp_path / "color.png")
    (tmp_path / "broken.png").write_bytes(b"no picture")
    for name, says in {
        "color.png": "its pixels are RGB, not gray values",
        "broken.png": "it cannot be read as an image",
        "angles.tif": "it holds 4 frames",
        "ball.jpg": r"it states a tone curve \(JPEG\)",
    }.items():
        with pytest.raises(CaptureError, match=says):
            imported([tmp_path / name] * 4)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    with pytest.raises(CaptureError, match="larger than any camera"):
        imported([tmp_path / "large.png"] * 4)
