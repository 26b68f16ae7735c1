"""Kinematics from measured poses and points, and what in them is not geometry.

In order: `poserecords`, `devices` (residuals), `chain` (parameterised kinematics), `starts`,
`posefit` and `posesolver`, `posegroups`, `levels` and `candidates` (what may be estimated), `kinematic_diagnosis`,
`corrections`, `calibrated`.
"""
