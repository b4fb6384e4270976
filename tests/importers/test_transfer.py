"""Pictures with a tone curve: refused, undone when it is stated, and found by four angles."""

import io
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pictures
import pytest
import xarray as xr
from cases import each
from PIL import Image, ImageCms

import polar_bayes as pb
from polar_bayes.capture.plausibility import cautions
from polar_bayes.errors import CaptureError
from polar_bayes.importers.detector import read_frame
from polar_bayes.importers.images import _spectral
from polar_bayes.importers.linearity import restoring_exponent
from polar_bayes.importers.transfer import as_transfer

FOUR = np.array([0.0, 45.0, 90.0, 135.0])
GRAY = Image.fromarray(np.arange(256, dtype=np.uint8).reshape(16, 16))
ICC = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def encoded(light):
    """The sRGB value of light, both from 0 to 1, by the forward formula of IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


# --- What files state -----------------------------------------------------------------------------


def png(name: bytes, body: bytes) -> bytes:
    """A PNG with one more chunk behind its header."""
    plain = io.BytesIO()
    GRAY.save(plain, "PNG")
    chunk = struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
    return plain.getvalue()[:33] + chunk + plain.getvalue()[33:]


def saved(kind: str, **settings) -> bytes:
    file = io.BytesIO()
    GRAY.save(file, kind, **settings)
    return file.getvalue()


def exif(color_space: int, gamma: float = 1.0) -> Image.Exif:
    found = Image.Exif()
    found[0xA001] = color_space
    found.get_ifd(0x8769)[0xA500] = gamma
    return found


CURVED = {
    "sRGB": png(b"sRGB", b"\0"),
    "gAMA 0.45455": png(b"gAMA", struct.pack(">I", 45455)),
    "ICC profile": saved("PNG", icc_profile=ICC),
    "EXIF ColorSpace sRGB": saved("PNG", exif=exif(1)),
    "EXIF ColorSpace Adobe RGB": saved("PNG", exif=exif(2)),
    "EXIF Gamma 2.2": saved("PNG", exif=exif(0xFFFF, gamma=2.2)),
    "ICC profile.tif": saved("TIFF", icc_profile=ICC),
    "JPEG": saved("JPEG"),
}
PLAIN = {
    "png": saved("PNG"),
    "tif": saved("TIFF"),
    "gAMA of linear counts": png(b"gAMA", struct.pack(">I", 100000)),
    "EXIF uncalibrated": saved("PNG", exif=exif(0xFFFF)),
}


@each("name", CURVED)
def test_a_frame_that_states_a_curve_is_refused_unless_a_transfer_is_given(name, tmp_path: Path):
    path = tmp_path / "frame.img"
    path.write_bytes(CURVED[name])
    stated = re.escape(f"frame.img: it states a tone curve ({name.removesuffix('.tif')})")
    with pytest.raises(CaptureError, match=f"{stated}.*; undo it by transfer='srgb'"):
        read_frame(path, "frame")
    for transfer in ("srgb", "linear", 2.2):
        values, level = read_frame(path, "frame", transfer)
        np.testing.assert_allclose(values, np.asarray(GRAY), atol=2.0 if name == "JPEG" else 0.0)
        assert level == 255.0


def test_a_color_picture_is_refused_with_its_curve(tmp_path: Path):
    """A copy of one channel would not state it."""
    path = tmp_path / "frame.jpg"
    Image.merge("RGB", [GRAY] * 3).save(path, "JPEG")
    said = r"its pixels are RGB.* one channel as .npy, and state by transfer= the curve .*\(JPEG\)"
    with pytest.raises(CaptureError, match=said):
        read_frame(path, "frame")


@each("name", PLAIN)
def test_a_frame_that_states_none_is_read_as_before(name, tmp_path: Path):
    path = tmp_path / "frame.img"
    path.write_bytes(PLAIN[name])
    np.testing.assert_array_equal(read_frame(path, "frame")[0], np.asarray(GRAY))


@each("transfer", ["rec709", 0.1, -2.2, "nan", True, [2.2]])
def test_an_unknown_transfer_is_refused(transfer):
    with pytest.raises(CaptureError, match=r"transfer: it is .*; give srgb, linear or"):
        pb.importers.Detector(transfer=transfer)


# --- Undoing --------------------------------------------------------------------------------------


@each("transfer", ["srgb", 2.2, "0.5"])
def test_a_transfer_is_the_inverse_of_its_curve_and_keeps_black_white_and_sign(transfer):
    light = np.linspace(0.0, 1.0, 101)
    curve = encoded(light) if transfer == "srgb" else light ** (1.0 / float(transfer))
    linear = as_transfer(transfer).linear
    np.testing.assert_allclose(linear(255.0 * curve, 255.0), 255.0 * light, atol=1e-4)
    np.testing.assert_allclose(linear(-255.0 * curve, 255.0), -255.0 * light, atol=1e-4)


def imported(frames, **detector) -> xr.Dataset:
    return pb.from_polarizer(
        list(frames), FOUR, shape=pictures.ball_normals(), light=pictures.LAMP, window=1,
        detector=pb.importers.Detector(**detector),
    )  # fmt: skip


@each("full", [255.0, 250.0, 238.0])
def test_an_srgb_capture_of_8_bits_is_the_linear_one_to_quantization(full: float):
    """Frames, dark and saturation level go through the curve; half a count is the bound."""
    dark, limit = as_transfer("srgb").linear(np.array([30.0, full]), 255.0)
    light = pictures.frames(FOUR, full=520.0) + dark
    picture = np.rint(255.0 * encoded(np.minimum(light / 255.0, 1.0))).astype(np.uint8)
    found = imported(picture, transfer="srgb", dark=30.0, saturation_level=full)
    wanted = imported(light, dark=float(dark), saturation_level=float(limit))
    both = found["valid"] & wanted["valid"]
    assert both.sum() > 400
    assert found.attrs["masked_saturated"] > 0
    assert found.attrs["transfer"] == "sRGB (IEC 61966-2-1), undone"
    assert found.attrs["tone_curve_uncertainty"] == 0.05
    assert found.attrs["saturation_level"] == pytest.approx(limit)
    # A count is 2.3 linear counts wide at white, so four angles add up to 2.3 at most.
    np.testing.assert_allclose(
        found["intensity"].where(both), wanted["intensity"].where(both), atol=1.2
    )
    off = (found["q"] - wanted["q"]) * wanted["intensity"] / 1.2
    assert float(abs(off.where(both)).max()) < 1.5
    naive = imported(picture, dark=30.0, saturation_level=full)
    assert float((abs(naive["q"] - wanted["q"]) * wanted["intensity"]).max()) > 5.0


# --- What four angles tell ------------------------------------------------------------------------


def scene(seed, e=1.0, passed=(1.0, 1.04, 0.97, 1.02), shift=0):
    """Smooth light of many polarizations behind four unequal analyzers, to the power e, noisy."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:48, :64] / 24.0
    waves = [np.sin(a * x + b * y + c) for a, b, c in rng.uniform(1.0, 4.0, (3, 3))]
    degree, turn = 0.25 + 0.2 * waves[0], 2.0 * np.pi * waves[1]
    turned = np.cos(np.deg2rad(2.0 * FOUR)[:, None, None] - turn)
    light = (0.3 + 0.15 * waves[2]) * (1.0 + degree * turned) * np.reshape(passed, (4, 1, 1))
    light = np.stack([np.roll(each, k * shift, axis=1) for k, each in enumerate(light)])
    counts = 1000.0 * light**e
    noise = 1.0 + 0.02 * counts
    return counts + np.sqrt(noise) * rng.normal(size=counts.shape), noise


@each("gamma", [0.6, 1.0, 1.4, 2.2])
def test_the_exponent_comes_back_within_its_uncertainty(gamma: float):
    everywhere = np.ones((48, 64), bool)
    found = np.array(
        [restoring_exponent(*scene(k, 1.0 / gamma), 0.01, FOUR, everywhere) for k in range(4)]
    )
    assert (found[:, 1] < 0.06 * gamma).all()
    assert (np.abs(found[:, 0] - gamma) < 4.0 * found[:, 1] + 0.02 * gamma).all()  # its bias


NORMALS = np.broadcast_to(pictures.unit(np.array([0.3, 0.5, 0.8])), (48, 64, 3))
KNOWN = {"shape": NORMALS, "light": pictures.LAMP}


def picture(seed, transfer=None, **asked) -> xr.Dataset:
    """The capture of a scene."""
    detector = pb.importers.Detector(saturation_level=1000.0, gain=0.02, transfer=transfer)
    return pb.from_polarizer(list(scene(seed, **asked)[0]), FOUR, detector=detector, **KNOWN)


@pytest.mark.thorough
@each("asked", [{}, {"shift": 1}, {"passed": (1.0, 0.8, 1.1, 0.9)}], ids=str)
def test_linear_frames_are_not_cautioned(asked: dict):
    """No alarm in 10 scenes each, which excludes rates above 26% at a level of 95%."""
    assert not [seed for seed in range(10) if cautions(picture(seed, **asked))]


def test_frames_with_a_curve_are_cautioned_with_the_gamma_that_mends_them():
    (sentence,) = cautions(picture(0, e=1.0 / 2.2))
    gamma = float(re.search(r"import them with transfer=([\d.]+) \(transfer='srgb'", sentence)[1])
    assert gamma == pytest.approx(2.2, abs=0.2)
    mended = picture(0, gamma, e=1.0 / 2.2)
    assert not cautions(mended)
    np.testing.assert_allclose(mended["q"], picture(0)["q"], atol=0.1)
    (sentence,) = cautions(picture(0, "srgb"))  # of linear frames
    assert "import them with transfer='linear'" in sentence


def test_an_exponent_below_1_is_no_curve_that_could_be_undone():
    assert 0.85 < picture(0, e=1.0 / 0.9).attrs["measured_gamma"] < 0.95
    (sentence,) = cautions(picture(0, e=1.0 / 0.9))
    assert sentence.endswith(
        "no tone curve has it: look for a wrong dark level or an object that moved."
    )


def test_colors_that_are_dark_leave_the_gamma_to_the_others():
    colors = [
        picture(k, e=1.0 / 2.2).assign_coords(wavelength=w) for k, w in enumerate((460.0, 610.0))
    ]
    del colors[0].attrs["measured_gamma"], colors[0].attrs["measured_gamma_error"]
    merged = _spectral(colors)
    assert merged.attrs["measured_gamma"] == colors[1].attrs["measured_gamma"]
    assert any("have a gamma of 2." in each for each in cautions(merged))


@each(("curve", "cautioned"), [(lambda x: x, False), (encoded, True)], ids=["linear", "srgb"])
def test_a_mosaic_that_is_partly_saturated(curve, cautioned: bool):
    frames = np.rint(255.0 * curve(np.clip(np.kron(scene(1)[0] / 600.0, np.ones((4, 4))), 0, 1)))
    raw = np.zeros(frames.shape[1:], np.uint8)
    for frame, (row, column) in zip(frames, ((1, 1), (0, 1), (0, 0), (1, 0)), strict=True):
        raw[row::2, column::2] = frame[row::2, column::2]
    normals = np.broadcast_to(NORMALS[0, 0], (*raw.shape, 3))
    capture = pb.from_mosaic(raw, shape=normals, light=pictures.LAMP, bin=4)
    assert capture.attrs["masked_saturated"] > 50
    assert any("have a gamma of 2." in each for each in cautions(capture)) == cautioned


def test_light_that_is_not_polarized_or_not_redundant_says_nothing():
    light, noise = scene(0)
    mean = np.broadcast_to(light.mean(axis=0), light.shape)
    everywhere = np.ones((48, 64), bool)
    rest = np.random.default_rng(0).normal(size=light.shape)
    curved = (mean + np.sqrt(noise) * rest) ** 0.45
    assert restoring_exponent(curved, 0.04 * noise / mean, 0.01, FOUR, everywhere) is None
    assert restoring_exponent(light[:3], noise[:3], 0.01, FOUR[:3], everywhere) is None
    line = (each.reshape(4, 1, -1) for each in scene(0, e=0.45))
    assert restoring_exponent(*line, 0.01, FOUR, everywhere.reshape(1, -1)) is None
