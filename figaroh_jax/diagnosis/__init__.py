"""What the simulation gets wrong: names, places and sizes of effects in a recording of torques.

In order: `design` and `problem` (rows and columns), `noise` and `floor` (what no model explains), `screening`, `refit`,
`comparison` and `search` (one cause after another), `rest`, `holdout` and `explain` (what is said of it). Its
answers stand in `figaroh_jax.results`.
"""
