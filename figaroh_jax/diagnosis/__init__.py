"""What the simulation gets wrong: names, places and sizes of effects in a recording of torques.

In order: `shifts` and `design` (rows and columns), `problem`, `layout` and `state` (the model of the data), `flexible`
and `floor` (what no model explains), `bank`, `evidence` and `screening` (which candidates the residual points to),
`refit`, `comparison`, `step`, `contenders`, `gates` and `search` (one cause after another), `joint` and `estimates`
(all of them fitted together), `holdout`, `gaining`, `rest`, `naming` and `judgement` (which of them are named),
`explain` and `experiment` (what is said of it), `diagnosis`. The answers stand in `figaroh_jax.results`.
"""
