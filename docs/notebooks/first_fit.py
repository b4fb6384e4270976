# %% [markdown]
# # A first fit
#
# You have measured how strongly light from a surface is polarized, from many directions, and want
# to know what the surface is made of: how rough it is, how much of the light comes from below it,
# how strongly the body absorbs, and its refractive index. None of these is read off directly. Many
# combinations explain the same readings, so the answer is not four numbers but the set of all
# combinations that the readings allow: a posterior.
#
# Here the capture is simulated, so that the truth is known and the answer can be checked.

# %%
import dataclasses

import matplotlib.pyplot as plt

import polar_bayes as pb
from polar_bayes.diagnostics.sensitivity import sensitivity

paper = pb.setups.SETUPS["paper"].scene
scene = dataclasses.replace(paper, surface=pb.RoughSurface(way_out=pb.physics.SmoothExit()))
protocol = pb.simulation.Protocol(views=24, wavelengths=())
capture = pb.simulate("plastic", scene=scene, protocol=protocol, seed=0)

# %% [markdown]
# `scene` is the optics: the paper's, but for light that leaves the body through a plane rather than
# through facets, which compiles sooner. Truth and fit share that shortcut here; for real data take
# the scene as it is (`pb.fit(capture)` does). 24 views stand on four azimuths at zeniths up to 85
# degrees, and the light falls in at 45. Each view has a degree of polarization and a brightness.

# %% mystnb={"image": {"alt": "Degree of polarization against view zenith, by azimuth"}}
for azimuth, part in capture.groupby("view_azimuth"):
    plt.plot(part["view_zenith"], part["dop"], "o-", label=f"azimuth {azimuth:.0f}")
plt.xlabel("view zenith (degree)")
plt.ylabel("degree of polarization")
plt.legend()
plt.show()

# %% [markdown]
# ## Three lines
#
# The default method draws from the posterior by importance sampling, and by NUTS where the weights
# of such draws do not reach all of it. Most of the time of a first fit is compilation.

# %%
result = pb.fit(capture, scene=scene, seed=0)
verdict = pb.verdict(result)
pb.summary(result).round(3)

# %% [markdown]
# A row for each parameter: mean and standard deviation of the posterior, its 95% interval, and
# diagnostics of the draws. The effective sample sizes are the numbers of independent draws with the
# same Monte Carlo error; `r_hat` near 1 means that all chains, or all parts of the weighted draws,
# found the same distribution. The last three rows are the noise and the exposure, which nobody knew
# and which are inferred with the rest.
#
# Before any number is quoted:

# %%
print("converged:", verdict.passed)
print("problems:", *verdict.problems)
print("cautions:", *verdict.cautions)

# %% [markdown]
# There is no problem, but there is a caution: with a film of water on the plastic, another index
# would explain these readings as well. Whoever knows that the plastic is dry may set it aside.
#
# A verdict without a problem is only half of the check. "Converged" means that the method worked,
# not that the readings were informative. That is the next question: how much narrower is each
# interval than it was before the data?

# %%
sensitivity(result)[["width_left", "verdict"]].round(2)

# %% [markdown]
# `width_left` is the width of the 95% interval over that of the prior. Roughness and subsurface
# fraction are determined well. The interval of the absorption is mostly that of the prior, and
# should not be quoted as a measurement.
#
# ## The picture, and the truth
#
# Gray is the prior, and the cross is the truth, which no fit reads.

# %% mystnb={"image": {"alt": "Histograms of the posterior of each parameter"}}
names = ("roughness", "subsurface_fraction", "absorption", "refractive_index")
figure, axes = plt.subplots(2, 2, figsize=(8, 6), layout="constrained")
for axis, name in zip(axes.flat, names, strict=True):
    prior = result["prior"][name].to_numpy().ravel()
    draws = result["posterior"][name].to_numpy().ravel()
    axis.hist(prior, 40, density=True, color="0.8")
    axis.hist(draws, 40, density=True, color="tab:blue", alpha=0.7)
    axis.plot(capture[f"true_{name}"], 0.0, "kx", ms=10, clip_on=False)
    axis.set_xlabel(name)
    axis.set_yticks([])
plt.show()

# %%
inside = {}
for name in names:
    low, high = result["posterior"][name].quantile([0.025, 0.975]).to_numpy()
    inside[name] = bool(low <= capture[f"true_{name}"] <= high)
print(inside)

# %% [markdown]
# One capture in which the truth lies inside is no proof: a 95% interval may miss one in twenty
# times, and an interval as wide as the prior nearly always holds. Whether intervals hold as often
# as they say takes many simulated captures: see [calibration and the
# paper](calibration_and_paper.py).
#
# Nor are parameters determined one by one. How they go together in the posterior:

# %%
result["posterior"].to_dataset().to_dataframe()[[*names, "exposure"]].corr().round(2)

# %% [markdown]
# Absorption and exposure go together most: a body that absorbs more, under a longer exposure, looks
# nearly the same. The index goes along, against both. So whoever measures the exposure, or
# photographs a white reference next to the sample, learns the absorption and the index better
# without touching either.
#
# ## The report
#
# `pb.report(result, "report")` writes all of this and more as one page that needs no other file,
# with the result next to it as a netCDF file.

# %%
page = pb.report(result, "report")
print(page.name, f"{page.stat().st_size / 1e6:.1f} MB")

# %% [markdown]
# ## Limits of this example
#
# The readings were drawn from the very scene and noise that were fitted. A wrong scene can fit
# well, and give a narrow and wrong answer without any warning: [measured
# plates](measured_plates.py) shows one. Next: [swap priors and links](priors_and_links.py), or read
# what [each diagnostic](../inference.md) means.
