# %% [markdown]
# # What accuracy costs in time
#
# Least squares answer in an instant, long chains in a minute. Which is good enough? That depends on
# the capture: on how far its posterior is from a normal distribution. So measure it: run the
# methods on the capture itself, compare each with a long reference of known error, and plot error
# against time.

# %%
# %matplotlib inline
import numpy as np
import xarray as xr

import polar_bayes as pb

# %% [markdown]
# The capture has six readings of a polished plate with a weak body: too few for a normal posterior,
# and quickly fitted.

# %%
plate = pb.Scene(pb.SmoothSurface(), pb.Unpolarized(), pb.StokesMixing())
links = {"q": pb.links.StokesLink(stated_errors=True)}
zenith = np.linspace(35.0, 75.0, 6)
directions = {
    "view_zenith": zenith,
    "view_azimuth": np.full(6, 180.0),
    "light_zenith": zenith,
    "light_azimuth": np.zeros(6),
}
truth = {"subsurface_fraction": 0.02, "refractive_index": 1.50}
q = np.asarray(plate.predict(truth, pb.Geometry.from_degrees(**directions))["q"])
q = np.clip(q + 0.02 * np.random.default_rng(0).normal(size=6), -1.0, 1.0)
capture = xr.Dataset(
    {name: ("view", values) for name, values in directions.items()}
    | {"q": ("view", q), "q_error": ("view", np.full(6, 0.02))},
    attrs={"name": "six readings"},
)

# %% [markdown]
# ## The study
#
# Five methods, no overrides, all in this process. (`fresh=True`, the default, gives each its own
# process and measures memory and the time of a first fit, compilation included, in minutes.)

# %%
names = ("point", "laplace", "importance", "nuts short", "nuts")
study = pb.accuracy(
    capture,
    scene=plate,
    links=links,
    methods={name: pb.methods.STUDY_METHODS[name] for name in names},
    overrides=(),
    fresh=False,
    reference=pb.benchmark.Reference(error=0.03),
)
columns = ["error", "worst", "resolved", "ess", "gradients", "seconds_again"]
pb.summary(study)[columns].round(3)

# %% mystnb={"image": {"alt": "Error of each method against its time"}}
pb.plots.plot_accuracy(study)

# %% [markdown]
# `error` is the largest error of any mean or standard deviation, in posterior standard deviations;
# `worst` names the parameter. For Laplace's approximation it is the factor on the stated errors:
# six readings determine it poorly, and its posterior is skewed, unlike a normal distribution. Least
# squares has no noise model, so that its row leaves the factor out, and is off by almost half a
# standard deviation in the rest. Weights and chains come much nearer. `resolved` is False where the
# error is at most twice that of the reference: the study cannot resolve such errors, and the figure
# is gray there.
#
# The seconds are those of a second fit, when all programs are compiled, on the machine that built
# this page and whatever else it did then.
#
# The same as a sentence:

# %%
print(*pb.benchmark.accuracy_sentences(study))

# %% [markdown]
# This advice holds for this capture. With more readings a posterior is closer to a normal
# distribution, and cheap methods are more accurate; [accuracy](../accuracy.md) explains how all of
# this is measured.
#
# ## Let it choose
#
# `method="auto"` needs no reference. It tries methods from cheap to exact and selects the first
# that passes its own diagnostics: here within a quarter of a posterior standard deviation.

# %%
result = pb.fit(
    capture, scene=plate, links=links, method=pb.methods.Auto(tolerance=0.25, seconds=600.0)
)
print(*pb.inference.auto_sentences(result), sep="\n")
pb.summary(result).round(3)

# %% [markdown]
# Importance sampling passed: no few draws have most of the weight, and there are enough of them for
# the tolerance. Where they are not enough, it runs again with more draws, and NUTS follows where
# the weights do not reach all of the posterior. Most of the seconds are compilation, which a second
# fit of this layout does not pay.
#
# No diagnostic here detects a wrong scene: every method is measured against the posterior, not
# against the truth. [Measured data](measured_plates.py) shows the difference.
