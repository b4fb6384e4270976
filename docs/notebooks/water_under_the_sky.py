# %% [markdown]
# # River water: from the wrong scene to the right one
#
# A fit always returns numbers. This notebook begins with the default scene, and follows the
# messages of the package to a better one. The index of water is known, 1.34; no fit uses it.
#
# The measurements belong to others and are not part of this project. To run this notebook, set
# `POLAR_BAYES_DATA` to a folder with `river_water/river_water_q.csv`: q of a river over the angle
# of incidence, with its errors.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt

import polar_bayes as pb

table = Path(os.environ["POLAR_BAYES_DATA"]) / "river_water" / "river_water_q.csv"

# %% [markdown]
# ## The table, and what is inferred from it
#
# Viewer and light are on opposite sides, at the same zenith angle: the mirror geometry.

# %% mystnb={"image": {"alt": "Signed polarization of water against the angle"}}
capture = pb.from_table(
    table,
    columns={"view_zenith": "aoi", "light_zenith": "aoi", "q_error": "err"},
    constants={"view_azimuth": 180.0, "light_azimuth": 0.0},
    ignored=["u"],
    name="river",
)
print(*pb.capture.inferred(capture), *pb.capture.cautions(capture), sep="\n")
plt.errorbar(capture["view_zenith"], capture["q"], capture["q_error"], fmt=".")
plt.xlabel("angle of incidence (degree)")
plt.ylabel("q")
plt.show()

# %% [markdown]
# ## The first scene that comes to mind
#
# A smooth surface that mirrors light into the viewer: that is a plate on a goniometer.

# %%
first = pb.fit(capture, scene="goniometer", seed=0)
row = pb.summary(first).loc["refractive_index"]
print(f"n = {row['mean']:.3f} [{row['q2.5']:.3f}, {row['q97.5']:.3f}]")
print(*pb.verdict(first).sentences, sep="\n")

# %% [markdown]
# The method may well have converged; the verdict still fails, because it judges the model, too.
# Each sentence names a contradiction between readings and model and ends with a remedy.

# %%
checks = pb.diagnostics.criticize(first)
print(checks[["level", "p_value"]].round(4).to_string())

# %% [markdown]
# ## Which scene?
#
# `compare_scenes` builds scenes from the parts that this capture allows, fits each, and stops when
# nothing is left to explain or nothing predicts better.

# %%
comparison = pb.compare_scenes(capture)
print(comparison.table[["elpd_diff", "dse", "weight", "criticism"]].round(2).to_string())
print(*pb.scenes.scene_sentences(comparison), sep="\n")

# %% [markdown]
# A river is lit by the whole sky, light comes back from below its surface, and the angle was not
# set by a stage. The scenes that lack one of these predict the readings worse by many nats, and
# their intervals of the index show the error that this causes:

# %%
index = comparison.intervals.loc["refractive_index"]
print(index.round(3).to_string())
best = comparison.table.index[0]
print(f"{best}: n from {index.loc[best, 'q2.5']:.3f} to {index.loc[best, 'q97.5']:.3f}")

# %% [markdown]
# These are weighted draws. `pb.fit(capture, scene="auto")` does the same, samples those scenes by
# NUTS whose weighted draws are not good enough, which takes minutes under a sky, and stacks them;
# `pb.verdict` then judges the result as that of any other fit. What it still criticizes is worth
# reading: no candidate explains all of these readings.
