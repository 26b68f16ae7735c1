"""Kinematics from measured poses and points, and what in them is not geometry.

In order: `candidates` (what may be estimated), `levels` (what is), `outliers`, `corrections` (what people read of it),
`calibration`, `kinematic_diagnosis`. Rows, Jacobians and solvers are those of `estimation.posefit` and its neighbours.
"""
