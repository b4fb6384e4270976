"""Two real plates, from what the laboratory wrote down to an interval and a page."""

import json

import pytest

import polar_bayes as pb
from polar_bayes.cli import main

PLATES = {
    "glass": (
        ["--s", "glass_fresnel/s1.txt", "--p", "glass_fresnel/p1.txt"],
        ["--s-incident", "1910", "--p-incident", "1630"],
        1.509,
    ),
    "plexiglas": (
        ["--table", "plexiglas_fresnel/plexiglas_A.csv"],
        ["--angle", "angle_deg", "--s", "I_s_uA", "--p", "I_p_uA"],
        1.489,
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("plate", ["glass", "plexiglas"])
def test_a_measured_plate_from_table_to_interval(plate, measured, tmp_path, capsys) -> None:
    """One and the same setting for both plates, as the commands' defaults have it."""
    files, columns, index = PLATES[plate]
    files = [str(measured / word) if "/" in word else word for word in files]
    capture, fit = tmp_path / "capture.nc", tmp_path / "fit.nc"
    assert main(["import", "goniometer", *files, *columns, "--out", str(capture)]) == 0
    assert "views" in capsys.readouterr().out
    status = main(["fit", str(capture), "--method", "nuts", "--json", "--out", str(fit)])
    said = json.loads(capsys.readouterr().out)
    assert status == 0, said["problems"]
    assert said["converged"]
    found = said["parameters"]["refractive_index"]
    assert found["q2.5"] < index < found["q97.5"]
    assert found["q97.5"] - found["q2.5"] < 0.2
    # Nothing but the surface reflects from a polished plate with an opaque back.
    assert said["parameters"]["subsurface_fraction"]["q97.5"] < 0.05
    result = pb.load(fit)
    assert "without_discrepancy" in result.children
    assert main(["report", str(fit), "--out", str(tmp_path / "report")]) == 0
    page = (tmp_path / "report" / "index.html").read_text()
    assert "overconfident" in page
