"""Measured plates and river water: their known index, by `scene="auto"` and no other setting."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import polar_bayes as pb


def glass(folder: Path) -> xr.Dataset:
    files = (folder / "glass_fresnel" / name for name in ("s1.txt", "p1.txt"))
    return pb.from_goniometer(*files, s_incident=1910.0, p_incident=1630.0)


def plexiglas(folder: Path) -> xr.Dataset:
    table = folder / "plexiglas_fresnel" / "plexiglas_A.csv"
    return pb.from_goniometer("I_s_uA", "I_p_uA", table=table, angle="angle_deg")


def river_water(folder: Path) -> xr.Dataset:
    columns = {"view_zenith": "aoi", "light_zenith": "aoi", "q": "q", "q_error": "err"}
    return pb.from_table(
        folder / "river_water" / "river_water_q.csv",
        columns=columns,
        ignored=["u"],
        constants={"view_azimuth": 180.0, "light_azimuth": 0.0},
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("read", "index"), [(glass, 1.509), (plexiglas, 1.489), (river_water, 1.34)]
)
def test_the_known_index_is_inside_the_interval(measured: Path, read, index: float) -> None:
    result = pb.fit(read(measured), scene="auto")
    assert pb.verdict(result).converged
    row = pb.summary(result).loc["refractive_index"]
    assert row["q2.5"] < index < row["q97.5"]
    assert row["q97.5"] - row["q2.5"] < 0.2
    if read is river_water:
        scenes = result["scenes"].to_dataset()
        remaining = scenes["scene"].to_numpy()[scenes["weight"].to_numpy() > 0.0]
        assert all("sky" in name and "body" in name for name in remaining)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("index", "share", "noise"), [(1.45, 1.0, 0.01), (1.52, 0.6, 0.01), (1.49, 0.8, 0.02)]
)
def test_a_slide_that_nobody_blackened_is_found(index: float, share: float, noise: float) -> None:
    angle = np.arange(15.0, 78.0, 2.5)
    mirror = pb.Geometry.from_degrees(
        view_zenith=angle, view_azimuth=180.0, light_zenith=angle, light_azimuth=0.0
    )
    slide = pb.Scene(pb.SmoothSurface(back=pb.physics.BackFace(share)))
    stokes = np.asarray(slide.stokes({"refractive_index": index}, mirror), float)
    random = np.random.default_rng(0)
    s, p = (
        1000.0
        * (stokes[:, 0] + sign * stokes[:, 1])
        * (1.0 + noise * random.normal(size=angle.size))
        for sign in (1.0, -1.0)
    )
    levels = {"s_incident": 1000.0, "p_incident": 1000.0, "relative_error": noise}
    result = pb.fit(
        pb.from_goniometer((angle, s.round(1)), (angle, p.round(1)), **levels), scene="auto"
    )
    assert pb.verdict(result).passed
    row = pb.summary(result).loc["refractive_index"]
    assert abs(row["mean"] - index) < 0.01
    assert row["q97.5"] - row["q2.5"] < 0.02
    assert "mirror + back face" in " ".join(pb.scenes.scene_sentences(result)[1:2])
