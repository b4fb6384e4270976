# %% [markdown]
# # Gallery
#
# Thirteen pictures, each with the lines that make it. All captures are simulated, so the truth is
# known, and the settings are small, so that a laptop draws each picture in less than a minute. The
# colors are those of Okabe and Ito, which color-blind people can distinguish.
#
# The first capture is a plastic under a lamp, seen by a polarization camera from 40 directions.

# %%
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import polar_bayes as pb

BLUE, GREEN, VERMILLION, GRAY = "#0072b2", "#009e73", "#d55e00", "#6b6b6b"
protocol = pb.simulation.Protocol(views=40, wavelengths=())
plastic = pb.simulate("plastic", scene="camera", protocol=protocol, seed=1)

# %% [markdown]
# ## Readings and the bands of a fit
#
# Half of new readings should fall in the dark band, and 95% in the light one. Readings that lie
# outside [contradict the model](criticism.md).

# %% mystnb={"image": {"alt": "Signed polarization against view zenith, with two bands of the fit"}}
fit = pb.fit(plastic, method="importance", seed=0)
pb.plots.plot_readings(fit, "q")

# %% [markdown]
# ## What a capture determines
#
# The bars show which share of a parameter's variance comes from the prior. Near 1 the readings add
# nothing, and the interval is [that of the prior](identifiability.md).

# %% mystnb={"image": {"alt": "Bars of the prior's share of the variance of each parameter"}}
found = pb.identify(plastic)
share = pb.summary(found)["prior_share"].sort_values()
plt.barh(share.index, share, color=BLUE)
plt.xlabel("share of the variance that the prior decides")
plt.xlim(0.0, 1.0)
plt.show()

# %% [markdown]
# ## A profile likelihood
#
# The index moves, and all other parameters follow so that the readings fit best. The likelihood
# ratio accepts every value whose curve is above the dashed line, at 95%. A curve that never crosses
# the line would mean that the readings [exclude nothing](identifiability.md#profile-likelihood).

# %% mystnb={"image": {"alt": "Log profile likelihood of the index, with the true value"}}
curve = pb.profile(plastic, "refractive_index", points=15)
plt.plot(curve["value"], curve["profile"].sel(kind="likelihood"), "o-", color=BLUE)
plt.axhline(-1.92, color=GRAY, linestyle="--")
plt.axvline(float(plastic["true_refractive_index"]), color=VERMILLION, label="true value")
plt.xlabel("refractive index")
plt.ylabel("log profile likelihood")
plt.ylim(-6.0, 0.5)
plt.legend()
plt.show()

# %% [markdown]
# ## The budget of an interval
#
# The interval of a fit covers noise and prior. A lamp that was placed by eye moves the answer as
# well, and no reading shows it. [The budget](setup_knowledge.md) compares all sources, each as a
# standard uncertainty of the roughness.

# %% mystnb={"image": {"alt": "Bars of the standard uncertainty of the roughness by source"}}
sources = pb.budget(fit).loc["roughness"].drop(["sd", "perfect"]).abs().sort_values()
plt.barh(sources.index, sources, color=GREEN)
plt.xlabel("standard uncertainty of the roughness")
plt.show()

# %% [markdown]
# ## Where to look next
#
# Of all directions in the measured azimuths, these would narrow the interval of the index most,
# and the curve shows [by how much](identifiability.md#choosing-further-views-optimal-design).

# %% mystnb={"image": {"alt": "Expected width of the interval of the index after each added view"}}
index = pb.design.SingleParameter("refractive_index")
views = pb.next_views(plastic, count=4, criterion=index, result=fit)
width = views["interval_width"].sel(parameter="refractive_index")
places = [
    f"{zenith:.0f}° at {azimuth:.0f}°"
    for zenith, azimuth in zip(
        views["view_zenith"].values, views["view_azimuth"].values, strict=True
    )
]
plt.plot(["now", *places], width, "o-", color=BLUE)
plt.ylim(0.0, 1.1 * float(width[0]))
plt.xlabel("view added: zenith at azimuth")
plt.ylabel("expected width of the 95% interval of n")
plt.show()

# %% [markdown]
# ## A map and its widths
#
# Every pixel of an image has its own posterior: the mean, its standard deviation, and a status that
# shows [whether it is reliable](maps.md). The corner at the top left is dark and noisy, so its
# intervals are wide.

# %% mystnb={"image": {"alt": "Maps of the mean and the standard deviation of each parameter"}}
y, x = np.mgrid[:24, :32]
smooth = pb.Scene(pb.SmoothSurface(), pb.Lambertian(), pb.StokesMixing())
asked = {"scene": smooth, "links": {"q": pb.links.StokesLink()}}
arc = pb.simulation.Protocol(views=12, largest_view_zenith=75.0, wavelengths=())
truth = {"refractive_index": np.where(x < 16, 1.42, 1.55), "subsurface_fraction": 0.3}
noise = {"stokes_scale": np.where(np.hypot(y, x) < 10.0, 0.01, 0.002)}
image = pb.simulate("plastic", protocol=arc, parameters=truth, noise=noise, **asked)
maps = pb.fit_pixels(image, method="laplace", **asked)
pb.plots.plot_maps(maps)

# %% [markdown]
# ## A map to point at
#
# Pointing at a pixel shows its parameters with their intervals, and a click shows [its readings
# and fitted values](maps.md#a-map-to-point-at). The slider hides pixels whose interval is wide.

# %%
pb.explore(maps, image)

# %% [markdown]
# ## Means of regions
#
# The interval of the mean over a region is much narrower than that of a pixel, because
# [errors of pixels are independent](maps.md#means-and-contrasts-of-regions), except for errors of
# shared parameters.

# %% mystnb={"image": {"alt": "Error of the mean index of three regions, with intervals"}}
labels = np.where(noise["stokes_scale"] > 0.002, "dark", np.where(x < 16, "left", "right"))
table = pb.maps.region_table(pb.maps.region_means(maps, labels)).set_index("parameter")
index = table.loc["refractive_index"].set_index("region").T
true = pd.Series({"dark": 1.42, "left": 1.42, "right": 1.55})
error = [index.loc["mean"] - index.loc["q2.5"], index.loc["q97.5"] - index.loc["mean"]]
plt.errorbar(index.columns, index.loc["mean"] - true, error, fmt="o", color=BLUE, capsize=5)
plt.axhline(0.0, color=VERMILLION, label="true value")
plt.ylabel("error of the mean index, 95% interval")
plt.margins(x=0.5)
plt.legend()
plt.show()

# %% [markdown]
# ## What each effect changes
#
# The second capture is a plate of glass on a goniometer. Each bar shows how far the result moves
# without one effect of the instrument. Effects beyond the dashed line [have to be
# kept](effects.md).

# %% mystnb={"image": {"alt": "Bars of the change of the posterior without each effect"}}
scan = pb.simulation.MirrorScan(views=20, largest_view_zenith=78.0, wavelengths=())
glass = pb.simulate("glass", scene="goniometer", protocol=scan, seed=0)
ledger = pb.choose_effects(glass).ledger.sortby("change")
plt.barh(ledger["effect"], ledger["change"], color=np.where(ledger["kept"], BLUE, GRAY))
plt.axvline(ledger.attrs["tolerance"], color=VERMILLION, linestyle="--")
plt.xlabel("largest change of a parameter (posterior standard deviations)")
plt.show()

# %% [markdown]
# ## Which scene?
#
# Scenes from simple to complex are fitted to the same readings. The weight shows how well each
# would predict new ones, and `pb.fit(glass, scene="auto")` [stacks the answers of those that
# remain](which_scene.md).

# %% mystnb={"image": {"alt": "Bars of the weight of each scene"}}
compared = pb.compare_scenes(glass)
weights = pb.scenes.scene_table(compared)["weight"].sort_values()
plt.barh(weights.index, weights, color=GREEN)
plt.xlabel("stacking weight")
plt.show()

# %% [markdown]
# ## Error against time
#
# The third capture has twelve readings of a smooth plate. Each method is compared with a
# long reference of the same posterior. Down and to the left [is better](accuracy.md).

# %% mystnb={"image": {"alt": "Error of each method against its time"}}
plate = pb.simulate("plastic", protocol=arc, noise={"stokes_scale": 0.002}, **asked)
names = ("laplace", "importance", "nuts short")
methods = {name: pb.methods.STUDY_METHODS[name] for name in names}
rough = pb.benchmark.Reference(error=0.03)
study = pb.accuracy(plate, methods=methods, overrides=(), fresh=False, reference=rough, **asked)
pb.plots.plot_accuracy(study)

# %% [markdown]
# ## Do intervals hold?
#
# Two hundred such plates are simulated and fitted. If the intervals are right, the ranks of
# the truth among the draws are uniform, and the curves stay [inside the band](calibration.md).

# %% mystnb={"image": {"alt": "Ranks of the truth and coverage of the intervals, with bands"}}
calibration = pb.calibrate(plate, simulations=200, method="importance", **asked)
pb.plots.plot_calibration(calibration)

# %% [markdown]
# ## An index between measured colors
#
# Three colors are coupled by a Gaussian process, which gives a posterior at [every wavelength
# between them](spectral.md).

# %% mystnb={"image": {"alt": "Index against wavelength: band of the coupled fit and true values"}}
three = pb.simulation.Protocol(views=12, wavelengths=(450.0, 550.0, 650.0))
low = {"stokes_scale": 0.002}
pmma = {"refractive_index": np.array([1.501, 1.494, 1.490])}
colored = pb.simulate("plastic", protocol=three, parameters=pmma, noise=low, **asked)
model = pb.models.GpSpectral(coupled=("refractive_index",))
coupled = pb.fit(colored, model=model, method="laplace", **asked)
pb.plots.plot_spectrum(coupled, "refractive_index")
