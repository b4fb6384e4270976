"""Mosaics of polarizers as captures: filled in, averaged, with the noise that is left."""

import importlib
import re
import sys

import numpy as np
import pictures
import pytest
from cases import each
from pictures import FOUR, FULL, LAMP, QUIET, mosaic
from PIL import Image

import polar_bayes as pb
from polar_bayes.errors import CaptureError
from polar_bayes.importers.images import SONY, from_mosaic, from_polarizer

FLAT = pictures.even((0.3, 0.5, 0.8))
INSIDE = {"y": slice(1, -1), "x": slice(1, -1)}
"""Away from the edges."""

KNOWN = {"shape": FLAT, "light": LAMP, "detector": QUIET, "bin": 4, "window": 1}
COLORS = (610.0, 530.0, 460.0)
NOISY = pb.importers.Detector(saturation_level=FULL, read_noise=3.0, gain=0.2, relative_error=0.0)


def imported(frame, **asked):
    return from_mosaic(frame, **KNOWN | asked)


def sloping(shape=pictures.SHAPE):
    """Frames whose light grows linearly over the frame, which filling in keeps."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    clean = pictures.frames(FOUR, normals=pictures.even(FLAT[0, 0], shape))
    return clean * (0.5 + 0.4 * row / shape[0] - 0.2 * column / shape[1])


@each("layout", [SONY, ((0.0, 45.0), (135.0, 90.0)), ((135.0, 0.0), (90.0, 45.0))])
def test_a_mosaic_tells_what_four_frames_tell(layout):
    """Any order of the four polarizers: away from the edges linear light comes back whole."""
    filled = imported(mosaic(sloping(), layout), layout=layout)
    whole = from_polarizer(sloping(), FOUR, **KNOWN)
    # The library works in steps of a 65535th of the frame's range.
    for name in ("q", "u"):
        np.testing.assert_allclose(filled[name].isel(INSIDE), whole[name].isel(INSIDE), atol=1e-4)
    assert np.ptp(whole["intensity"].values) > 0.2 * float(whole["intensity"].max())
    np.testing.assert_allclose(
        filled["intensity"].isel(INSIDE), whole["intensity"].isel(INSIDE), rtol=1e-4
    )


def test_a_wrong_layout_does_not_pass():
    right = imported(mosaic(sloping()))
    wrong = imported(mosaic(sloping()), layout=((0.0, 45.0), (135.0, 90.0)))
    assert np.abs(right["q"] - wrong["q"]).max() > 0.01


def test_a_ball_comes_back_in_the_plane_of_the_model():
    """Curved light is smeared by filling in: within .03 of the scene, and of both signs."""
    shape, ball = (160, 160), pb.importers.Sphere(80.2, 79.7, 74.0)
    normals = pictures.ball_normals(shape, ball)
    frames = pictures.frames(FOUR, normals=normals)
    capture = imported(mosaic(frames), shape=ball)
    valid = capture["valid"].values & (capture["view_zenith"].values < 70.0)
    valid &= capture["light_zenith"].values < 70.0
    said = pictures.predicted(capture, valid)
    assert valid.sum() > 500
    for name in ("q", "u"):
        off = capture[name].values[valid] - said[name]
        assert np.abs(off).max() < 0.03
        assert np.sqrt(np.mean(off**2)) < 0.005
        assert said[name].min() < -0.02
        assert said[name].max() > 0.02


@pytest.mark.thorough
@each("width", [2, 4, 8])
def test_the_noise_that_is_left_is_the_stated_one(width):
    """Scores of q over a frame of even light; neighbors share a little noise.

    With 64 x 64 squares at least and correlations below .3 to eight neighbors, the mean square
    has a standard error below .05; the bound is four of them.
    """
    shape = (64 * width, 64 * width)
    passed = np.array([300.0, 220.0, 100.0, 180.0])  # at each angle
    frames = np.broadcast_to(passed[:, None, None], (4, *shape))
    rng = np.random.default_rng(width)
    clean = mosaic(frames)
    raw = clean + np.sqrt(9.0 + 0.2 * clean) * rng.normal(size=shape)
    normals = pictures.even(FLAT[0, 0], shape)
    capture = imported(raw, shape=normals, detector=NOISY, bin=width).isel(INSIDE)
    for name in ("q", "u"):
        score = (capture[name] - capture[name].mean()) / capture[f"{name}_error"]
        assert float((score**2).mean()) == pytest.approx(1.0, abs=0.2)
    assert capture.attrs["median_misfit"] < 3.0


@pytest.mark.thorough
def test_noise_below_the_dark_level_is_kept():
    """Cut off at zero, dark pixels would look brighter than they are."""
    rng = np.random.default_rng(5)
    frames = np.broadcast_to(np.array([6.0, 5.0, 4.0, 5.0])[:, None, None], (4, 256, 256))
    raw = mosaic(frames) + 100.0 + 8.0 * rng.normal(size=(256, 256))
    assert (raw < 100.0).mean() > 0.1
    detector = pb.importers.Detector(
        saturation_level=FULL, dark=100.0, read_noise=8.0, relative_error=0.0
    )
    normals = pictures.even(FLAT[0, 0], (256, 256))
    capture = imported(raw, shape=normals, detector=detector, bin=64)
    np.testing.assert_allclose(capture["intensity"].mean(), 5.0, atol=5.0 * 8.0 / 256.0)


def test_a_full_pixel_masks_all_that_is_filled_in_from_it():
    raw = mosaic(sloping())
    raw[7, 20] = FULL  # at the lower edge of its square of four rows
    capture = imported(raw)
    full = np.argwhere(capture["saturated"].values[..., 0])
    assert {tuple(place) for place in full.tolist()} == {(1, 4), (1, 5), (2, 4), (2, 5)}
    assert not capture["valid"].values[capture["saturated"].values].any()


@pytest.mark.thorough
def test_a_frame_in_a_file(tmp_path):
    raw = np.rint(mosaic(sloping()) * 0.5).astype(np.uint8)
    Image.fromarray(raw).save(tmp_path / "plate.png")
    file = imported(tmp_path / "plate.png", detector=None)
    array = imported(raw, detector=None, name="plate")
    assert file.attrs["name"] == "plate"
    assert file.attrs["source"] == "plate.png"
    assert file.attrs["demosaicing"].startswith("polanalyser ")
    assert file.attrs["saturation_level"] == 255.0
    assert file.drop_attrs().equals(array.drop_attrs())


@each(
    ("asked", "said"),
    [
        ({"layout": ((0, 180), (90, 90))}, "the polarizer stood at 2 different angles"),
        ({"layout": (0, 45, 90, 135)}, "layout: it is (0, 45, 90, 135)"),
        ({"bin": 3}, "bin: it is 3; give an even number"),
        ({"frame": np.ones((5, 4))}, "frame: it is (5, 4), not even"),
        ({"color": (460, 530, 610)}, "color: it is (460, 530, 610); give the centers of red"),
        ({"color": (610, 530)}, "color: it is (610, 530)"),
        ({"color": COLORS, "bin": 6}, "it is 6; give a multiple of 4"),
        ({"color": COLORS, "wavelength": 550.0}, "a color mosaic has no one wavelength"),
    ],
)
def test_a_mistake_is_told_with_its_mend(asked, said):
    with pytest.raises(CaptureError, match=re.escape(said)):
        imported(**{"frame": np.ones(pictures.SHAPE)} | asked)


def test_without_the_library_the_way_to_it_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "polanalyser", None)
    with pytest.raises(CaptureError, match=re.escape("pip install 'polar_bayes[camera]'")):
        imported(np.ones(pictures.SHAPE))
    monkeypatch.undo()
    assert importlib.import_module("polanalyser")


# --- In color -------------------------------------------------------------------------------------

BAYER = (("red", "green"), ("green", "blue"))
LIGHT = {"red": 1.0, "green": 0.7, "blue": 0.4}


def color_mosaic(frames, light=LIGHT):
    """Return the mosaic of a color sensor: squares of four polarizers behind a Bayer pattern."""
    mono, found = mosaic(frames), np.zeros(frames[0].shape)
    for row, column in np.ndindex(4, 4):
        share = light[BAYER[row // 2][column // 2]]
        found[row::4, column::4] = share * mono[row::4, column::4]
    return found


def test_a_color_mosaic_is_three_wavelengths():
    """Each color with its own brightness and the same polarization, away from the edges."""
    filled = imported(color_mosaic(sloping()), color=COLORS, bin=8)
    whole = from_polarizer(sloping(), FOUR, **KNOWN | {"bin": 8})
    assert filled["q"].dims == ("y", "x", "view", "wavelength")
    assert filled["wavelength"].values.tolist() == [460.0, 530.0, 610.0]
    for name in ("q", "u"):
        off = filled[name].isel(INSIDE) - whole[name].isel(INSIDE)
        assert float(np.abs(off).max()) < 1e-3  # steps of a 65535th of the frame, of the blue
    for center, share in zip(COLORS, LIGHT.values(), strict=True):
        bright = filled["intensity"].sel(wavelength=center).isel(INSIDE)
        np.testing.assert_allclose(bright, share * whole["intensity"].isel(INSIDE), rtol=1e-3)
    assert filled.attrs["masked_saturated"] == 0


@pytest.mark.thorough
def test_the_noise_of_each_color_is_the_stated_one():
    """Scores of q over a frame of even light, as of a monochrome mosaic above."""
    shape, passed = (64 * 4, 64 * 4), np.array([300.0, 220.0, 100.0, 180.0])
    clean = color_mosaic(np.broadcast_to(passed[:, None, None], (4, *shape)))
    noise = np.random.default_rng(1).normal(size=shape)
    raw = clean + np.sqrt(9.0 + 0.2 * clean) * noise
    normals = pictures.even(FLAT[0, 0], shape)
    capture = imported(raw, shape=normals, color=COLORS, detector=NOISY)
    capture = capture.isel(y=slice(2, -2), x=slice(2, -2))
    for center in COLORS:
        color = capture.sel(wavelength=center)
        score = (color["q"] - color["q"].mean()) / color["q_error"]
        # Blue and red share their noise with the next blocks, so fewer are independent.
        assert float((score**2).mean()) == pytest.approx(1.0, abs=0.2)


# --- How counts are kept --------------------------------------------------------------------------


def test_bits_aligned_to_the_left_are_read_at_their_own_full_count():
    raw = np.rint(mosaic(sloping()))
    plain = imported(raw, detector=pb.importers.Detector(saturation_level=4095.0))
    left = (16.0 * raw).astype(np.uint16)
    for level in (4095.0, 65535.0):
        with pytest.raises(CaptureError, match=r"multiples of 16: 12 bits .*level=, here 65520"):
            imported(left, detector=pb.importers.Detector(saturation_level=level))
    scaled = pb.importers.Detector(saturation_level=16.0 * 4095.0, read_noise=16.0)
    found = imported(left, detector=scaled)
    np.testing.assert_allclose(found["q"], plain["q"], atol=1e-4)
    np.testing.assert_allclose(found["q_error"], plain["q_error"], rtol=1e-3)


def test_shares_of_full_light_need_their_noise():
    raw = mosaic(sloping()) / FULL
    with pytest.raises(CaptureError, match="1 for shares of full light"):
        imported(raw, detector=None)
    with pytest.raises(CaptureError, match="read_noise: it is 1, and a pixel is full at 1; give"):
        imported(raw, detector=pb.importers.Detector(saturation_level=1.0))
    detector = pb.importers.Detector(saturation_level=1.0, read_noise=1.0 / FULL)
    assert imported(raw, detector=detector)["valid"].all()


def test_a_packed_file_is_refused_by_the_way_to_unpack_it(tmp_path):
    (tmp_path / "frame.raw").write_bytes(bytes(range(96)))
    with pytest.raises(CaptureError, match=r"a raw file does not say how .* unpack it with NumPy"):
        imported(tmp_path / "frame.raw", detector=None)
