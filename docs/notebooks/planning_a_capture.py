# %% [markdown]
# # Planning a capture
#
# Time at the instrument is short. Two questions come first: can the planned views determine the
# parameters of interest, and where should views be added? Both can be answered before anything is
# measured, since the information of a reading follows from the optics and the noise.

# %%
import dataclasses

import matplotlib.pyplot as plt

import polar_bayes as pb

paper = pb.setups.SETUPS["paper"].scene
scene = dataclasses.replace(paper, surface=pb.RoughSurface(way_out=pb.physics.SmoothExit()))
protocol = pb.simulation.Protocol(views=8, largest_view_zenith=60.0, wavelengths=())
capture = pb.simulate("leaf", scene=scene, protocol=protocol, seed=0)

# %% [markdown]
# Eight views of a leaf, no steeper than 60 degrees: a short first capture. (The scene lets light
# out of the body through a plane, which compiles sooner than the paper's facets.)
#
# ## What can the capture determine?

# %%
found = pb.identify(capture, scene=scene)
pb.summary(found).round(3)

# %%
print(*pb.verdict(found).sentences, sep="\n")

# %% [markdown]
# `expected_sd` is the expected sd of the posterior, `prior_share` the share of its variance that
# comes from the prior. Roughness and subsurface fraction will be known well, the absorption hardly
# at all: readings depend on it (its `sensitivity` is large), but in the same way as on the
# exposure. The index is in between, and is correlated with the exposure, too. `paper_sd` is the sd
# by the paper's information, which counts polarization alone, with a smaller information than its
# noise carries; see [what a capture can
# tell](../identifiability.md#the-papers-information-and-the-exact-one).
#
# ## Profile likelihood: which values do the data exclude?
#
# The table is a linearization at one point. A profile moves one parameter, fits all others again at
# every value, and shows whether the readings exclude it.

# %% mystnb={"image": {"alt": "Log profile likelihood of the refractive index"}}
curve = pb.profile(capture, "refractive_index", scene=scene)
print(*pb.verdict(curve).sentences, sep="\n")
curve["profile"].sel(kind="likelihood").plot.line("o-", x="value")
plt.axhline(-1.92, color="0.7")
plt.axvline(float(capture["true_refractive_index"]), color="k", linestyle=":")
plt.ylim(-6.0, 0.5)
plt.title("")
plt.show()

# %%
others = curve["others"].sel(kind="likelihood").isel(value=[0, curve.sizes["value"] // 2, -1])
others.transpose("value", ...).to_pandas().round(3)

# %% [markdown]
# The readings alone exclude what is below 1.38 and nothing above, up to 1.84, although the table
# expects an sd of 0.05. Both are right. Where the index is moved, absorption and exposure make up
# for it: at the lower end a body that absorbs four times as much, at the upper end one that does
# not absorb at all. The table includes the prior, under which such bodies are rare. So the interval
# of the index in a fit of these eight views depends on the prior of the absorption, and a measured
# exposure or absorption would be more valuable than it seems.
#
# ## Where to look next
#
# State what the set-up can do, and what is to be learned. Here the arm reaches 80 degrees, two
# views are at least 5 degrees apart, viewer and light hide each other within 8 degrees, and the
# question is the refractive index.

# %%
constraints = pb.design.Constraints(view_zenith=(0.0, 80.0), minimum_separation=5.0, from_light=8.0)
views = pb.next_views(
    capture,
    count=3,
    constraints=constraints,
    criterion=pb.design.SingleParameter("refractive_index"),
    scene=scene,
)
print(*pb.verdict(views).sentences, sep="\n")
pb.summary(views)

# %% [markdown]
# Two steep views on the mirror side, as the paper would take them, and one at 22.5 degrees. The
# intervals of the index and of the other parameters become about a fifth narrower.
#
# ## How much do chosen views help?
#
# The prediction depends on a linearization and on the model. [A
# benchmark](../identifiability.md#how-much-do-chosen-views-help) checks it on 200 simulated
# materials of the paper's scene: views chosen for the index leave 72% of its posterior sd, evenly
# spaced ones 86%, random ones 91%, and the predicted sds are correct within 4%.
#
# No such choice accounts for a wrong scene. Views that distinguish a wrong scene from a right one
# are not those that narrow its parameters; reserve some views for them.
