"""What random effects find among 60 parameters of 20 simulated robots on two days, three of which truly differ.

    python benchmarks/units.py [--studies N] [--seed K]

By how far the three differ between robots (in standard deviations of one estimate): how many of them are named, how
many studies name a false one; with honest standard deviations, and with ones stated half as large as they are.
"""

from __future__ import annotations

import argparse

import numpy as np

from figaroh_jax.estimation.units import spreads

PARAMETERS, UNITS, DAYS, DIFFERENT = 60, 20, 2, (7, 23, 41)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first study")
    options = parser.parse_args()
    print(f"{'spread':>7}{'stated std':>12}{'found of three':>16}{'studies with a false one':>26}")
    for size in (1.0, 1.5, 2.0, 3.0):
        for stated in (1.0, 0.5):
            told = [_study(np.random.default_rng(options.seed + k), size, stated) for k in range(options.studies)]
            found = np.mean([len(names & set(DIFFERENT)) for names in told])
            false = np.mean([bool(names - set(DIFFERENT)) for names in told])
            print(f"{size:7.1f}{stated:12.1f}{found:16.2f}{100 * false:24.1f} %", flush=True)


def _study(rng: np.random.Generator, size: float, stated: float) -> set[int]:
    std = rng.uniform(0.05, 0.5, PARAMETERS) * rng.uniform(0.7, 1.4, (UNITS * DAYS, PARAMETERS))
    own = np.zeros((UNITS, PARAMETERS))
    own[:, DIFFERENT] = size * std.mean(0)[list(DIFFERENT)] * rng.normal(size=(UNITS, len(DIFFERENT)))
    values = rng.normal(0, 5, PARAMETERS) + np.repeat(own, DAYS, axis=0) + std * rng.normal(size=std.shape)
    labels = [str(i) for i in range(UNITS) for _ in range(DAYS)]
    found = spreads([str(k) for k in range(PARAMETERS)], values, stated * std, labels)
    return {int(one.name) for one in found if one.differs()}


if __name__ == "__main__":
    main()
