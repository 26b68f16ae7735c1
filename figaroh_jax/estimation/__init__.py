"""What the jobs share: priors, noise, regressions, solvers and their intervals."""
