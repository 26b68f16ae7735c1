"""What the simulation gets wrong: names, places and sizes of effects in a recording of torques.

In order: `records`, `layout`, `shifts` and `design` (rows and columns), `priors`, `problem`, `rows` and `state` (the
model of the data), `noise`, `flexible` and `floor` (what no model explains), `bank`, `evidence` and `screening`
(which candidates the residual points to), `refit`, `comparison`, `step`, `contenders`, `gates` and `search` (one
cause after another), `joint` and `estimates` (all of them fitted together), `rest`, `holdout`, `explain` and
`experiment` (what is said of it), `diagnosis`. The answers stand in `figaroh_jax.results`.
"""
