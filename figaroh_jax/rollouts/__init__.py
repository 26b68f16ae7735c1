"""Rollouts: identification and diagnosis from command and position alone, without any torque.

Reading order: `friction` (constraints), `loop` (one step), `simulation`, `reading` (loops of robot files), `data`,
`parameters`, `sensitivity`, `fit`, `causes`, `search`.
"""
