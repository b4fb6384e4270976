"""Benefit and cost of pooling, and how the cost grows.

    python benchmarks/pooling.py alike        hierarchical against separate fits
    python benchmarks/pooling.py different    the same, where members truly differ
    python benchmarks/pooling.py patches      30 patches of 40 views, NUTS
    python benchmarks/pooling.py gradient     one gradient, 10 to 1000 patches

The first two simulate weak readings of smooth plates. `patches` prints seconds after compilation (a
second run of the same program) and the diagnostics.
"""

import functools
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import jax
import jax.numpy as jnp
import numpy as np
from patches import patch_capture
from plates import LINKS, PLATE, plates

import polar_bayes as pb
from polar_bayes.inference.hierarchical_reparam import (
    HierarchicalReparam,
    ReparamInputs,
    find_groups,
)
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.inference.result import provenance_of
from polar_bayes.observation.data import observe

REPLICATES, MEMBERS, ERROR = 20, 8, 0.05
SPREADS = {"alike": 0.02, "different": 0.12}


def replicates(label: str) -> None:
    """RMSE, width and coverage of the index, over all members of all replicates."""
    spread = SPREADS[label]
    print(f"{REPLICATES} replicates of {MEMBERS} plates, 6 views, error {ERROR} in q")
    rows: dict[str, list[tuple[float, float, float]]] = {}
    converged = {"hierarchical": 0, "per_material": 0}
    for seed in range(REPLICATES):
        rng = np.random.default_rng(1000 + seed)
        truth = np.clip(rng.normal(1.5, spread, MEMBERS), 1.25, 1.95)
        capture = plates(truth, ERROR, seed=seed)
        for model in converged:
            asked = {"scene": PLATE, "links": LINKS, "method": "nuts", "seed": seed}
            result = pb.fit(capture, model=model, **asked)
            converged[model] += pb.verdict(result).passed
            draws = result["posterior"]["refractive_index"].stack(all=("chain", "draw"))
            low, high = draws.quantile([0.025, 0.975], "all").to_numpy()
            errors = draws.mean("all").to_numpy() - truth
            rows.setdefault(model, []).append(
                (
                    float(np.mean(errors**2)),
                    float(np.mean(high - low)),
                    float(np.mean((low <= truth) & (truth <= high))),
                )
            )
    print(f"\n{label} (sd {spread})")
    for model, found in rows.items():
        mean = np.mean(found, axis=0)
        error = np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
        rmse = np.sqrt(mean[0])
        print(
            f"  {model:<13} RMSE {rmse:.4f} +- {error[0] / (2 * rmse):.4f}   width "
            f"{mean[1]:.4f} +- {error[1]:.4f}   coverage {mean[2]:.3f} +- {error[2]:.3f}   "
            f"converged {converged[model]} of {REPLICATES}",
            flush=True,
        )


def patches() -> None:
    """The paper's scene, 30 patches of 40 views: seconds and diagnostics."""
    index = np.clip(np.random.default_rng(1).normal(1.45, 0.05, 30), 1.21, 1.99)
    capture = patch_capture(index, views=40, seed=3)
    for run in ("first", "again"):
        start = time.perf_counter()
        result = pb.fit(capture, model="hierarchical", seed=0)
        seconds = time.perf_counter() - start
        table = pb.summary(result)
        hyper = table.loc[[name for name in table.index if "[" not in name]]
        print(
            f"{run}: {seconds:.0f} s {provenance_of(result)['timings']}; divergences "
            f"{int(result['sample_stats']['diverging'].sum())}, R-hat at most "
            f"{table['r_hat'].max():.4f}, ESS of what is shared at least "
            f"{hyper[['ess_bulk', 'ess_tail']].min().min():.0f}, of all "
            f"{table[['ess_bulk', 'ess_tail']].min().min():.0f}; converged "
            f"{pb.verdict(result).passed}",
            flush=True,
        )


def gradient() -> None:
    """Milliseconds of one gradient in the coordinates that are sampled."""
    for count in (10, 30, 100, 300, 1000):
        capture = patch_capture(np.full(count, 1.45), views=40)
        request = resolve(capture, "hierarchical", None, None, None, None, 0, "double")
        with jax.enable_x64(True):
            data = observe(request.capture)
            program = compile_program(request.bind(), data)
            groups = find_groups(program, data)
            assert groups is not None
            transport = HierarchicalReparam(program, groups)
            local, common = groups.local.shape, groups.common.size
            given = ReparamInputs(
                data,
                jnp.zeros(common),
                jnp.eye(common),
                jnp.zeros(local),
                jnp.zeros(local),
                jnp.broadcast_to(jnp.eye(local[1]), (*local, local[1])),
                jnp.zeros((*local, common)),
            )
            w = jnp.zeros(program.size)
            both = jax.jit(jax.value_and_grad(transport.potential))
            jax.block_until_ready(both(w, given))
            times = []
            for _ in range(15):
                start = time.perf_counter()
                jax.block_until_ready(both(w, given))
                times.append(time.perf_counter() - start)
        milliseconds = 1e3 * float(np.median(times))
        print(
            f"{count:5d} patches {milliseconds:8.2f} ms  {1e3 * milliseconds / count:6.1f} us each"
        )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        tasks = {label: functools.partial(replicates, label) for label in SPREADS}
        (tasks | {"patches": patches, "gradient": gradient})[sys.argv[1]]()
