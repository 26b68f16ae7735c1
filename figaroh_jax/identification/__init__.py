"""Parameters of links and drives from torques: base parameters, physically consistent links, friction.

In order: `reversal`, `judgement` (a word on each parameter), `result`, `identification`; rows of other kinds:
`wrenches`, `plates`, `payloads`, `acceleration_free`, `instruments`; `people`. What fits stands in `estimation`.
"""
