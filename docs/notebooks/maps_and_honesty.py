# %% [markdown]
# # Maps, and which pixels to trust
#
# A camera gives every pixel its own readings, so every pixel can have its own posterior. A map of
# means looks convincing whether or not it is accurate. So a map here has, for each pixel, the width
# of its posterior, the method that found it, and a status. On a simulated image one can count how
# often the intervals contain the truth.

# %%
# %matplotlib inline
import numpy as np
import numpyro
import pandas as pd

import polar_bayes as pb
from polar_bayes.models.per_material import per_material

# %% [markdown]
# ## An image with a shadow and a highlight
#
# Two plastics meet along an edge; index and body vary over each. On the left a shadow, on the right
# a highlight that fills the sensor. 12 views of 24 x 32 pixels; the surface is smooth, so that the
# programs compile in seconds.

# %%
y, x = np.mgrid[:24, :32]
texture = np.sin(y / 2.5) * np.cos(x / 3.0)
left = x + 3.0 * np.sin(y / 4.0) < 16.0
truth = {
    "subsurface_fraction": np.where(left, 0.5, 0.3) + 0.1 * texture,
    "refractive_index": np.where(left, 1.42, 1.55) + 0.03 * texture,
}
shadow = np.hypot(y - 16.0, x - 8.0) < 4.0
highlight = np.hypot(y - 8.0, x - 24.0) < 4.0
scene = pb.Scene(pb.SmoothSurface(), pb.Lambertian(), pb.StokesMixing())
links = {"q": pb.links.StokesLink(), "intensity": pb.links.StudentTLink()}
image = pb.simulate(
    "plastic",
    scene=scene,
    links=links,
    protocol=pb.simulation.Protocol(views=12, largest_view_zenith=75.0, wavelengths=()),
    parameters=truth,
    noise={"exposure": np.where(shadow, 0.08, np.where(highlight, 120.0, 4.0))},
    seed=0,
)
print(pb.capture.count(image))

# %% [markdown]
# A camera whose channels are saturated cannot measure polarization there. Readings at full scale
# are marked as not valid: they stay in the capture, are counted, and contribute nothing.

# %%
image = image.assign(valid=~image["saturated"])

# %% [markdown]
# ## The map
#
# Polarization alone is fitted, with its noise known; brightness only determines the noise of a
# reading.

# %%
model = numpyro.handlers.condition(per_material, data={"stokes_scale": 0.01})
fitted = {"model": model, "scene": scene, "links": {"q": pb.links.StokesLink()}}
maps = pb.fit_pixels(image, **fitted)
print(pb.maps.count_pixels(maps))

# %% mystnb={"image": {"alt": "Maps of means, widths and status"}}
pb.plots.plot_maps(maps)

# %% [markdown]
# 717 pixels are good. The readings of 6 contradict the model, as those of a few right pixels in a
# thousand do by chance in each check, and the 45 of the highlight are masked: both have a status
# but no number. The index (whose width is drawn below its mean) is known well where the plate is
# bright, and hardly in the shadow. An image of means alone would not show that.
#
# ## Do the intervals hold?
#
# For comparison, here is a map by the uncorrected normal approximation:

# %%
bare = pb.fit_pixels(image, method="laplace", **fitted)
held = ["held_50", "held_80", "held_95", "held_95_low", "held_95_high", "unanswered"]
both = {"corrected": maps, "normal approximation": bare}
pd.concat(
    {name: pb.diagnostics.map_coverage(some, image)[held] for name, some in both.items()}
).round(3)

# %% [markdown]
# Both have nearly their nominal coverage; the correction changes little, because with twelve
# readings and two unknowns these posteriors are nearly normal. Where they are not, it matters: [the
# numbers](../maps.md#report-and-coverage-of-a-map).
#
# Strictly, coverage is promised on average over truths that are drawn from the prior. These truths
# were painted, so a share slightly above or below does not contradict the map; a very different
# share would.
#
# ## Precise and imprecise pixels

# %%
regions = {"shadow": shadow, "highlight": highlight, "elsewhere": ~shadow & ~highlight}
for name, region in regions.items():
    sd = maps["refractive_index_sd"].where(region)
    score = (maps["refractive_index"] - truth["refractive_index"]).where(region) / sd
    print(
        f"{name}: {int(region.sum())} pixels, {int(sd.notnull().sum())} with an answer,"
        f" median sd of the index {float(sd.median()):.3f},"
        f" rms of error over sd {float(np.sqrt((score**2).mean())):.2f}"
    )

# %% [markdown]
# In the shadow the noise is stronger, and the sd of the map is more than twice as large. Errors
# there are even smaller than the sd (a ratio below 1), since the prior shrinks uncertain pixels
# towards its center, where these truths happen to be. Elsewhere errors are as large as the sd.
#
# ## What goes wrong if the stated noise is wrong
#
# A map uses the noise that it is given. Here the stated noise is half the true noise:

# %%
bold = numpyro.handlers.condition(per_material, data={"stokes_scale": 0.005})
overconfident = pb.fit_pixels(image, **(fitted | {"model": bold}))
print(pb.maps.count_pixels(overconfident))
pb.diagnostics.map_coverage(overconfident, image)[held].round(3)

# %% [markdown]
# In 504 pixels, the readings contradict so little noise, and the pixels have no answer. The 95%
# intervals of the others contain only seven in ten truths, although their status is good: their
# draws describe the posterior well, and it is the posterior that is wrong. Where so many pixels are
# contradicted, do not trust the rest: fit the noise on a patch first, or leave it unknown (slower,
# and wider).
#
# ## The mean of a region
#
# Pixels are independent given their shared parameters, and here there are none:

# %%
means = pb.maps.region_means(maps, shadow)
pb.maps.region_table(means).round(4)

# %%
print(*means.attrs["cautions"], sep="\n")

# %% [markdown]
# The interval is that of the map's own model, in which each pixel has a prior of its own. Where the
# pixels of a region are alike, all those priors bias the mean in the same direction. In the dark
# pixels of the shadow the priors are more informative on the index than the readings, which the
# caution reports: fit such a region as one capture, or as [patches of one
# population](pooling_and_spectra.py). How maps are made, and how fast: [maps](../maps.md).
