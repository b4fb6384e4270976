r"""Reparametrization of two shares by their sum, which readings determine better.

Light from inside a body and leakage between the channels of a polarizer both take polarization
away. A smooth plate tells their sum s, and hardly which of the two it is: one is large where the
other is small, along a bend that chains follow in short steps. They run along s and the share t of
the first in it instead,

$$ p_1 = s t, \quad p_2 = s (1 - t), \quad s = T(x_1), \quad \log\frac{t}{1-t} = v(x_2) $$

with T the transform of the first, v the log odds of a normal score (`polar_bayes.priors.log_odds`),
and p a value itself or, of one below h, $-h \log(1 - \text{value}/h)$, so that any sum is one of
values in their ranges. The density is exact. Where one of the two is held, nothing is changed.

Source:
    Gilks and Roberts 1996, "Strategies for improving MCMC", in Markov Chain Monte Carlo in
    Practice, 89-114 (reparametrization by what the data determine).
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro.distributions import transforms

from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.priors import constraint_bounds, log_odds, log_slope, score_of_log_odds


@dataclasses.dataclass(frozen=True, eq=False)
class SumReparam:
    """The map between a program's coordinates and those of a sum and a share.

    Args:
        names: The site whose range has no end, and the other one.
        positions: Of their coordinates in a vector.
        ends: Ends of their ranges, which begin at 0; the first is infinite.
        moves: From the coordinates of a program to values, of both.
    """

    names: tuple[str, str]
    positions: tuple[int, int]
    ends: tuple[float, float]
    moves: tuple[transforms.Transform, transforms.Transform]

    def forward(
        self, x: Float[Array, " size"], data: Observations
    ) -> tuple[Float[Array, " size"], Float[Array, ""]]:
        """Return the coordinates of the program, and the log volume of the map."""
        first, second = self.positions
        odds = log_odds(x[second])
        total, least = self.moves[0](x[first]), 2.0 * jnp.finfo(x.dtype).tiny ** 0.5
        parts = [jnp.maximum(total * jax.nn.sigmoid(each), least) for each in (odds, -odds)]
        volume = self.moves[0].log_abs_det_jacobian(x[first], total) + jnp.log(total + least)
        volume += log_slope(x[second]) - jnp.logaddexp(odds, 0.0) - jnp.logaddexp(-odds, 0.0)
        z, known = x, self._is_held(data)
        for at, end, move, part in zip(self.positions, self.ends, self.moves, parts, strict=True):
            value = part if math.isinf(end) else -end * jnp.expm1(-part / end)
            coordinate = move.inv(value)
            volume -= move.log_abs_det_jacobian(coordinate, value)
            volume -= 0.0 if math.isinf(end) else part / end
            z = z.at[at].set(jnp.where(known, x[at], coordinate))
        return z, jnp.where(known, 0.0, volume)

    def backward(self, z: Float[Array, " size"], data: Observations) -> Float[Array, " size"]:
        """Return the coordinates of a vector of the program."""
        parts = []
        for at, end, move in zip(self.positions, self.ends, self.moves, strict=True):
            value = move(z[at])
            parts.append(value if math.isinf(end) else -end * jnp.log1p(-value / end))
        first, second = self.positions
        total, odds = self.moves[0].inv(parts[0] + parts[1]), jnp.log(parts[0] / parts[1])
        moved = z.at[first].set(total).at[second].set(score_of_log_odds(odds))
        return jnp.where(self._is_held(data), z, moved)

    def _is_held(self, data: Observations) -> Array:
        held = [~jnp.isnan(data.held[name]) for name in self.names if name in data.held]
        return functools.reduce(jnp.logical_or, held, jnp.zeros((), bool))


def find_sum(program: Program) -> SumReparam | None:
    """Return the map of two sites with `infer={"summed": True}`; None without such sites."""
    found = {}
    for name in program.summed:
        low, high = constraint_bounds(program.supports[name])
        if low == 0.0:
            found[name] = high
    names = sorted(found, key=found.__getitem__, reverse=True)
    if len(names) != 2 or math.isfinite(found[names[0]]):
        return None
    first, second = names
    at = program.positions
    return SumReparam(
        names=(first, second),
        positions=(int(at[first]), int(at[second])),
        ends=(found[first], found[second]),
        moves=(dist.biject_to(program.supports[first]), dist.biject_to(program.supports[second])),
    )
