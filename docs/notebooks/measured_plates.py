# %% [markdown]
# # Measured data, from the raw file to a conclusion
#
# Simulated captures obey the model that fits them. Measured ones do not. This notebook has two
# examples: a glass plate, whose readings a simple model fits closely but wrongly; and white PTFE,
# where the paper's mixture fits better than the physics does, and gives the wrong index.
#
# The measurements belong to others and are not part of this project. To run this notebook, set
# `POLAR_BAYES_DATA` to a folder with `glass_fresnel/s1.txt`, `glass_fresnel/p1.txt` (a laser
# reflected by a plate, s and p apart; from github.com wohlrath/307-fresnely) and
# `ptfe_mueller/ptfe_inplane_532_633.csv` (Mueller matrices of sintered PTFE by NIST; from
# github.com AlexCast/ptfe_eg_error).

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr

import polar_bayes as pb
from polar_bayes.diagnostics.compare import compare_without
from polar_bayes.diagnostics.predictive import predictive_checks

folder = Path(os.environ["POLAR_BAYES_DATA"])

# %% [markdown]
# ## Glass: from two tables to a capture
#
# Each file has the angle of incidence in degrees and the detector's reading. The incident beam read
# 1910 in s and 1630 in p. The index of this glass is known from elsewhere: 1.509. The fit does not
# use it.

# %% mystnb={"image": {"alt": "Signed polarization of glass against the angle"}}
print((folder / "glass_fresnel" / "s1.txt").read_text()[:40])
capture = pb.from_goniometer(
    folder / "glass_fresnel" / "s1.txt",
    folder / "glass_fresnel" / "p1.txt",
    s_incident=1910.0,
    p_incident=1630.0,
    wavelength=633.0,
    name="glass",
)
print(pb.capture.count(capture))
plt.errorbar(capture["view_zenith"], capture["q"], capture["q_error"], fmt=".")
plt.xlabel("angle of incidence (degree)")
plt.ylabel("q")
plt.show()

# %% [markdown]
# q rises to nearly 1 near Brewster's angle, where hardly any p light is mirrored, and falls again.
# Three things are not in the optics: the two channels may not be equally sensitive, the angle scale
# may be off, and beyond 78 degrees the beam is longer than the plate (these views are set aside,
# and counted).
#
# ## The fit
#
# A capture from a goniometer names its set-up: Fresnel's laws, a little unpolarized light from
# below, and an instrument with an angle zero, a ratio of channels, a leakage, and a smooth error
# over angle that nobody knows (the discrepancy).

# %%
result = pb.fit(capture, seed=0)
print(*pb.verdict(result).sentences, sep="\n")
pb.summary(result)[["mean", "q2.5", "q97.5", "r_hat", "ess_bulk"]].round(3)

# %% [markdown]
# Every such fit is repeated twice, without the discrepancy and without any instrument term:

# %%
columns = ["q2.5", "q97.5", "q2.5_without", "q97.5_without"]
for part in ("discrepancy", "instrument"):
    print(f"without {part}:")
    print(compare_without(result, part)[columns].loc[["refractive_index"]].round(3))

# %% [markdown]
# With all terms, the interval of the index contains 1.509. It is wide, because it includes possible
# errors of the instrument. Without any instrument term it is ten times narrower and does not
# contain the index. That fit looks close, since index and body imitate channels that are off by
# some percent; only its residuals have structure over the angle, which `pb.compare_scenes` reports.
#
# ## PTFE: the better fit is the wrong one
#
# Sintered PTFE is white: nearly all light comes from the body, unpolarized, and the surface adds a
# little that is polarized. Its index is 1.35 to 1.38. NIST measured Mueller matrices in the plane
# of incidence; `m21` is q for unpolarized light, with noise of about .006. Here 633 nm, five angles
# of incidence.

# %%
ptfe = pd.read_csv(folder / "ptfe_mueller" / "ptfe_inplane_532_633.csv")
ptfe = ptfe[(ptfe["lambda_um"] == 0.633) & (ptfe["theta_i_deg"] > 0.0)]
turn = ptfe["theta_r_signed_deg"].to_numpy()
white = xr.Dataset(
    {
        "view_zenith": ("view", np.abs(turn)),
        "view_azimuth": ("view", np.where(turn >= 0.0, 180.0, 0.0)),
        "light_zenith": ("view", ptfe["theta_i_deg"].to_numpy()),
        "light_azimuth": ("view", np.zeros(turn.size)),
        "q": ("view", ptfe["m21"].to_numpy()),
        "q_error": ("view", np.full(turn.size, 0.006)),
    },
    attrs={"name": "PTFE"},
)
print(pb.capture.count(white))

# %% [markdown]
# Two ways to add up surface and body. The paper's equation 1 mixes degrees of polarization by one
# fraction, the same for every view (here with its sign). `StokesMixing` adds the light itself, so
# that the surface counts more where it is brighter; that needs to know how rough it is.

# %%
rough = pb.RoughSurface(pb.GGX(), way_out=pb.physics.SmoothExit())
scenes = {
    "one fraction for all views": pb.Scene(
        pb.SmoothSurface(), pb.Unpolarized(), pb.DopMixing(signed=True)
    ),
    "light adds up": pb.Scene(rough, pb.Unpolarized(), pb.StokesMixing()),
}
links = {"q": pb.links.StokesLink(degrees_of_freedom=4.0, stated_errors=True)}
fits = {name: pb.fit(white, scene=scene, links=links) for name, scene in scenes.items()}
rows = {}
for name, fit in fits.items():
    index, check = pb.summary(fit).loc["refractive_index"], predictive_checks(fit)["q"]
    rows[name] = {
        "index, 2.5%": index["q2.5"],
        "97.5%": index["q97.5"],
        "share at 1.38 or below": float((fit["posterior"]["refractive_index"] <= 1.38).mean()),
        "rms residual": check.residual_rms,
        "elpd": check.loo.elpd,
    }
    print(f"{name}:", *pb.verdict(fit).problems, *pb.verdict(fit).cautions, sep="\n")
rows["prior"] = {"share at 1.38 or below": float((fit["prior"]["refractive_index"] <= 1.38).mean())}
pd.DataFrame(rows).T.round(4)

# %% mystnb={"image": {"alt": "Signed polarization of PTFE and two fits"}}
steep = ptfe["theta_i_deg"].to_numpy() == 75.0
for name, fit in fits.items():
    predicted = fit["posterior_predictive"]["q"].quantile([0.025, 0.975], ("chain", "draw"))
    low, high = predicted.to_numpy()[:, steep]
    plt.fill_between(turn[steep], low, high, alpha=0.3, label=name)
plt.plot(turn[steep], white["q"][steep], "k.", label="read")
plt.xlabel("angle of reflection (degree), light at 75 degrees from the left")
plt.ylabel("q")
plt.legend()
plt.show()

# %% [markdown]
# One fraction for all views fits better by every measure here: residuals are a third smaller, and
# the readings are better predicted. And it moves the index the wrong way. Almost a third of the
# prior is at 1.38 or below, where the index of PTFE is, but almost none of the posterior. The sum
# of light fits worse, above all at the steep end, where it expects more polarization than there is:
# this surface is not made of GGX facets on one smooth boundary. Its interval is wide enough for the
# right index, but does not determine it. Of the two, the better fit is the one that is surely
# wrong.
#
# The same file says why one fraction for all views cannot be right. Its brightness was not fitted:

# %% mystnb={"image": {"alt": "Brightness of PTFE against the angle of reflection"}}
plt.plot(turn[steep], ptfe["f_r11_per_sr"][steep], "o-")
plt.xlabel("angle of reflection (degree), light at 75 degrees from the left")
plt.ylabel("brightness (1/sr)")
plt.ylim(0.0)
plt.show()

# %% [markdown]
# On the side of the light the brightness is flat, as that of a matt body is. On the mirror side it
# rises by two thirds: that rise is light of the surface. So the surface has a third or more of the
# light at 64 degrees and hardly any at -40, while the fitted fraction gives it the same few percent
# everywhere. A fit of polarization alone cannot detect this.
#
# ## What to conclude
#
# * Glass: quote the wide interval, with what it assumes
#   ([goniometer](../goniometer.md#assumptions-of-the-fit)).
# * PTFE: quote no index. The data hardly determine it with either scene, and the scene that fits
# best is contradicted by the brightness. Measure the specular lobe, or add its brightness to the
# fit.
# * Fit quality does not choose between scenes. What is known of the sample does.
