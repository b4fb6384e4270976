# %% [markdown]
# # Swapping priors and links
#
# A posterior depends on three assumptions: the optics, the prior, and the distribution of readings
# around their prediction (the link). Anyone who doubts a result should be able to replace one of
# them and see how it changes. This takes a line each. Here the optics stay as they are; prior and
# link change.

# %%
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from numpyro import distributions as dist
from numpyro import handlers

import polar_bayes as pb
from polar_bayes.diagnostics.predictive import predictive_checks
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.inference.result import provenance_of
from polar_bayes.models.per_material import per_material

# %% [markdown]
# ## A plate with two bad readings
#
# A polished plate of index 1.50 over a body that adds a little unpolarized light, seen at 14 angles
# in the mirror direction. `q` is the signed degree of polarization; its stated error is 0.01. Two
# readings are off by twenty errors, as if dust had lain in the beam.

# %%
plate = pb.Scene(pb.SmoothSurface(), pb.Unpolarized(), pb.StokesMixing())
truth = {"subsurface_fraction": 0.02, "refractive_index": 1.50}
zenith = np.linspace(30.0, 75.0, 14)
directions = {
    "view_zenith": zenith,
    "view_azimuth": np.full(14, 180.0),
    "light_zenith": zenith,
    "light_azimuth": np.zeros(14),
}
q = np.asarray(plate.predict(truth, pb.Geometry.from_degrees(**directions))["q"])
q = q + 0.01 * np.random.default_rng(0).normal(size=14)
q[[3, 10]] -= 0.2
capture = xr.Dataset(
    {name: ("view", values) for name, values in directions.items()}
    | {"q": ("view", q), "q_error": ("view", np.full(14, 0.01))},
    attrs={"name": "dusty plate"},
)

# %% [markdown]
# ## The link
#
# With normal noise a reading twenty errors away is next to impossible, so the other parameters have
# to change: index, body, or the fitted factor on the stated errors. Student's t with four degrees
# of freedom allows for occasional outliers.

# %%
links = {
    "normal": pb.links.StokesLink(stated_errors=True),
    "Student's t": pb.links.StokesLink(degrees_of_freedom=4.0, stated_errors=True),
}
fits = {
    name: pb.fit(capture, scene=plate, links={"q": link}, method="laplace")
    for name, link in links.items()
}
columns = ["mean", "q2.5", "q97.5"]
pd.concat({name: pb.summary(fit)[columns] for name, fit in fits.items()}).round(3)

# %% mystnb={"image": {"alt": "Readings of q and the bands of each fit"}}
for name, fit in fits.items():
    predicted = fit["posterior_predictive"]["q"].quantile([0.025, 0.5, 0.975], ("chain", "draw"))
    low, middle, high = predicted.to_numpy()
    (line,) = plt.plot(zenith, middle, label=name)
    plt.fill_between(zenith, low, high, color=line.get_color(), alpha=0.2)
plt.plot(zenith, q, "k.", label="read")
plt.xlabel("angle of incidence (degree)")
plt.ylabel("q")
plt.legend()
plt.show()

# %% [markdown]
# With the normal link mainly the noise changed: the errors are six times the stated ones, and so
# the interval of the index is three to four times as wide as with Student's t. Its mean did not
# move far, since bad readings on both sides of Brewster's angle pull in both directions. With other
# bad readings it could have.
#
# Which link describes these readings better? The expected log predictive density measures how well
# each reading is predicted by all others; higher is better.

# %%
checks = {name: predictive_checks(fit)["q"].loo for name, fit in fits.items()}
pd.DataFrame(
    {
        name: {"elpd": check.elpd, "error": check.standard_error, "largest k": max(check.pareto_k)}
        for name, check in checks.items()
    }
).T.round(2)

# %% [markdown]
# Student's t is ahead, by less than the standard error of a sum over fourteen readings. And the
# Pareto k of a bad reading is above 0.7: its leave-one-out prediction is unreliable. Where two
# points decide, the figure is more informative than the table.
#
# ## The prior
#
# A data sheet says 1.50 within 0.005. Any continuous NumPyro distribution will do; other parameters
# keep their default priors. What happens if the sheet is of another material, and states 1.60?

# %%
robust = {"scene": plate, "links": {"q": links["Student's t"]}, "method": "laplace"}
beliefs = {
    "default": {},
    "data sheet": {"refractive_index": dist.TruncatedNormal(1.50, 0.005, low=1.0)},
    "wrong sheet": {"refractive_index": dist.TruncatedNormal(1.60, 0.005, low=1.0)},
}
answers = {name: pb.fit(capture, priors=prior, **robust) for name, prior in beliefs.items()}
pd.concat({name: pb.summary(answer)[columns] for name, answer in answers.items()}).round(3)

# %% [markdown]
# The right sheet narrows the interval of the index to a third, the wrong one moves it to 1.60, with
# as narrow an interval. No check of that fit fails, as far as draws of Laplace's approximation can
# be judged. Where does the result come from?

# %%
sensed = ["width_left", "prior_sensitivity", "likelihood_sensitivity", "verdict", "remark"]
pd.concat({name: sensitivity(answer)[sensed] for name, answer in answers.items()}).round(2)

# %% [markdown]
# With either sheet the index has the width that the sheet gave it (`width_left` near 1: "not
# determined") and depends on the prior. That is intended for a reliable sheet; the table cannot
# show whether the sheet is right. The readings can: with the wrong sheet the fitted noise is nearly
# three times that with the right one (`stokes_error_factor`). An estimated noise well above the
# stated one is the first thing to look at after a prior was narrowed.
#
# ## Fixing a parameter
#
# A value that is not in doubt is held by a handler of NumPyro rather than by a narrow prior. It is
# then not a parameter of the posterior any more.

# %%
known = handlers.condition(per_material, data={"refractive_index": np.float64(1.50)})
held = pb.fit(capture, model=known, **robust)
pb.summary(held)[columns].round(3)

# %% [markdown]
# What was replaced is saved with the result, and its report shows it:

# %%
said = provenance_of(held)
print(said["fixed"], said["links"])

# %% [markdown]
# ## Limits of this example
#
# A link that is robust to outliers also hides a wrong scene: readings that the optics cannot
# explain look like bad ones. Where several neighbors are off together, ask for an effect that the
# scene is missing rather than for longer tails; [effects](../effects.md) lists the candidates.
# Models of your own: [swapping](../swapping.md) and [extending](../extending.md). Next: [many
# materials and colors](pooling_and_spectra.py).
