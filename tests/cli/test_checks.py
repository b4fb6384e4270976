"""Calibration and identifiability as a user types them."""

import json
import shutil
from pathlib import Path

import pytest
import xarray as xr

from polar_bayes.cli import main
from polar_bayes.cli.captures import SCALES
from polar_bayes.importers.mirror import ANGLE_IS


@pytest.mark.thorough
def test_calibrate_prints_a_table_and_writes_every_fit(plate, plate_scene, tmp_path, capsys):
    out = tmp_path / "sbc.nc"
    words = ["calibrate", str(plate), "--simulations", "20", "--method", "laplace"]
    words += ["--scene", plate_scene]
    status = main([*words, "--out", str(out)])
    header, *rows = capsys.readouterr().out.splitlines()
    assert header.split()[:3] == ["answered", "failed", "p_value"]
    assert rows[1].split()[0] == "refractive_index"
    assert any(row.startswith("held_50, held_80, held_95: share of intervals") for row in rows)
    assert rows[-1].startswith("Next: ")
    verdict = next(row for row in rows if "alibrated: " in row)
    assert status == (0 if verdict.startswith("Calibrated") else 2)
    assert any(row.startswith("q, left out") for row in rows)
    with xr.open_datatree(out) as tree:
        assert tree["prior_sbc"].sizes["simulation"] == 20
    store = f"{tmp_path / 'sbc.nc.fits'}"
    assert main([*words, "--out", str(out)]) == 1
    assert capsys.readouterr().err.splitlines() == [
        f"{store}: it is there already; give another --out, or --resume"
    ]
    assert main([*words, "--out", str(out), "--resume", "--seed", "1"]) == 1
    assert capsys.readouterr().err.splitlines() == [
        f"{store}/journal: it was begun with another seed; "
        "repeat the command as it was, or give another --out"
    ]
    more = [*words[:3], "24", *words[4:], "--out", str(out), "--resume", "--json"]
    assert main(more) in (0, 2)
    told = json.loads(capsys.readouterr().out)
    assert told["parameters"]["refractive_index"]["answered"] <= 24
    assert "q, fresh" in told["readings"]
    shutil.rmtree(store)
    assert main([*words, "--out", str(out), "--resume"]) == 1
    assert "nothing is left to resume; give another --out" in capsys.readouterr().err


def test_identify_says_what_is_told_and_where_to_look(plate, plate_scene, capsys) -> None:
    words = ["identify", str(plate), "--next-views", "2", "--scene", plate_scene]
    words += ["--from-light", "40"]
    assert main([*words, "--criterion", "refractive_index", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert 0.0 < told["parameters"]["refractive_index"]["prior_share"] < 0.5
    assert told["sentences"]
    widths = told["next views"]["refractive_index"]
    assert widths["after 2"] < widths["after 1"] < widths["now"]
    assert told["next views: sentences"][0].startswith("Look next at zenith ")
    assert told["next views: sentences"][-1].startswith("Candidates had zeniths from ")
    assert "at least 40 degrees from the light" in told["next views: sentences"][-1]
    assert told["next views: sentences"][-1].endswith("polar-bayes identify --from-light 30.")
    assert main([*words, "--criterion", "bend"]) == 1
    assert capsys.readouterr().err.splitlines() == [
        "SingleParameter('bend'): no parameter of the material has that name; "
        "give one of subsurface_fraction, refractive_index"
    ]


@pytest.mark.thorough
def test_identify_follows_a_profile(plate: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", str(plate), "--profile", "subsurface_fraction", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    curve = told["profile of subsurface_fraction"]
    followed = [row["likelihood"] for row in curve.values()]
    assert None not in followed
    assert max(followed) == 0.0
    assert told["profile of subsurface_fraction: sentences"][0].startswith(
        "subsurface_fraction is "
    )


def test_options_offer_every_scale_of_the_angle() -> None:
    assert tuple(ANGLE_IS) == SCALES
