"""The paper's protocol: about 40 views to 85 degrees, several azimuths, three wavelengths."""

import numpy as np
import pytest
from cases import each

from polar_bayes.errors import CaptureError
from polar_bayes.simulation import MirrorScan, Protocol


def test_the_default_is_the_papers():
    protocol = Protocol()
    angles = protocol.angles()
    assert {name: angle.shape for name, angle in angles.items()} == dict.fromkeys(angles, (40,))
    assert angles["view_zenith"].max() == 85.0
    azimuths = np.unique(angles["view_azimuth"])
    assert len(azimuths) == 4
    for azimuth in azimuths:  # every one sees the whole range
        seen = angles["view_zenith"][angles["view_azimuth"] == azimuth]
        assert seen.min() < 10.0
        assert seen.max() > 75.0
    assert len(protocol.wavelengths) == 3


def test_zeniths_step_evenly_up_to_the_largest():
    zeniths = Protocol(views=5, largest_view_zenith=50.0).angles()["view_zenith"]
    np.testing.assert_allclose(zeniths, [10.0, 20.0, 30.0, 40.0, 50.0], rtol=1e-15)


@pytest.mark.thorough
def test_the_light_stands_still():
    angles = Protocol(views=3, light_zenith=30.0).angles()
    np.testing.assert_array_equal(angles["light_zenith"], np.full(3, 30.0))
    np.testing.assert_array_equal(angles["light_azimuth"], np.zeros(3))


@pytest.mark.thorough
def test_more_azimuths_than_views_are_not_all_used():
    angles = Protocol(views=2, azimuths=(180.0, 90.0, 0.0)).angles()
    np.testing.assert_array_equal(angles["view_azimuth"], [180.0, 90.0])


def test_a_scan_looks_in_the_mirror_direction_of_its_light():
    angles = MirrorScan(views=4, smallest_view_zenith=15.0, largest_view_zenith=75.0).angles()
    for name in ("view_zenith", "light_zenith"):
        np.testing.assert_allclose(angles[name], [15.0, 35.0, 55.0, 75.0], rtol=1e-15)
    np.testing.assert_array_equal(angles["view_azimuth"] - angles["light_azimuth"], np.full(4, 180))
    for smallest in (-1.0, 76.0, float("nan")):
        with pytest.raises(CaptureError, match=r"smallest_view_zenith is .*; give degrees from 0"):
            MirrorScan(smallest_view_zenith=smallest, largest_view_zenith=75.0)


@each(
    ("field", "value"),
    [
        ("views", 1),
        ("views", 2.5),
        ("views", True),
        ("views", 100_001),
        ("largest_view_zenith", 0.0),
        ("largest_view_zenith", 90.0),
        ("largest_view_zenith", float("nan")),
        ("light_zenith", -1.0),
        ("light_zenith", 90.0),
        ("azimuths", ()),
        ("azimuths", (361.0,)),
        ("azimuths", (180.0, float("nan"))),
        ("wavelengths", (0.0,)),
        ("wavelengths", (550.0, float("inf"))),
    ],
)
def test_a_field_outside_its_range_is_refused_by_name(field, value):
    with pytest.raises(CaptureError) as caught:
        Protocol(**{field: value})
    message = str(caught.value)
    assert message.startswith(f"Protocol: {field} is {value}; give ")
    assert "\n" not in message
