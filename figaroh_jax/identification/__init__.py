"""Parameters of links and drives from torques: base parameters, least squares, links that can exist, intervals.

In order: `columns`, `regression` (rows), `states` (`devices`; `wrenches`, `acceleration_free` and `payloads` for other
rows), `base_parameters`, `least_squares` (`instruments`), `consistency` (`conic`), `intervals`, `judgement` (a word on
each parameter), `result`.
"""
