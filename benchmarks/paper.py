"""The paper's evaluation on simulated materials, table by table.

    python benchmarks/paper.py table1       every class: error, coverage, width
    python benchmarks/paper.py table2       with and without views beyond 75 degrees
    python benchmarks/paper.py ablations    noise models that are wrong, and pooling
    python benchmarks/paper.py methods      least squares, Laplace, weights, NUTS
    python benchmarks/paper.py figures      the pictures of docs/paper.md, into docs/figures

Options: --simulations N of each cell, --method of `polar_bayes.calibrate`, --seed. Each prints a
table in markdown. Captures have 40 views of the degree of polarization and the intensity, one
color, by the paper's scene with four facets on the way out, for truth and fit alike.
"""

import argparse
import os
import platform
import time

from paper_ablations import ablations
from paper_figures import figures
from paper_methods import methods
from paper_study import Study
from paper_tables import table1, table2

TASKS = {
    "table1": (table1, 100),
    "table2": (table2, 50),
    "ablations": (ablations, 20),
    "methods": (methods, 100),
    "figures": (figures, 60),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--simulations", type=int, help="of each cell of the table")
    parser.add_argument("--method", default="importance", help="of polar_bayes.calibrate")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    task, usual = TASKS[asked.task]
    study = Study(asked.simulations or usual, asked.method, asked.seed)
    print(f"{study}; {platform.machine()}, {os.cpu_count()} cores\n", flush=True)
    begun = time.perf_counter()
    task(study)
    print(f"\n{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
