"""Views without a capture: arrays as `polar_bayes.observation.data.observe` would make them."""

import jax.numpy as jnp
import numpy as np

from polar_bayes.observation.data import Observations
from polar_bayes.physics.geometry import Geometry


def make_observations(
    view_zenith,
    *,
    readings=None,
    brightness=0.7,
    error=0.01,
    saturated=False,
    full_scale=np.inf,
    leading=(),
    dtype=np.float64,
):
    """Observations of one row of views, repeated over leading axes (name, length)."""
    zenith = jnp.asarray(view_zenith, dtype)
    shape = (*(length for _, length in leading), zenith.size)

    def full(value, kind=dtype):
        return jnp.broadcast_to(jnp.asarray(value, kind), shape)

    return Observations(
        geometry=Geometry.from_degrees(
            view_zenith=zenith,
            view_azimuth=jnp.full_like(zenith, 180.0),
            light_zenith=jnp.full_like(zenith, 45.0),
            light_azimuth=jnp.zeros_like(zenith),
        ),
        readings={name: full(value) for name, value in (readings or {}).items()},
        errors={name: full(error) for name in ("dop", "q", "u", "intensity")},
        brightness=full(brightness),
        full_scale=jnp.asarray(full_scale, dtype),
        intensity_unit=jnp.asarray(1.0, dtype),
        valid=full(True, bool),
        saturated=full(saturated, bool),
        dims=(*leading, ("view", zenith.size)),
    )
