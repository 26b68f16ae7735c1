"""Motions, postures and experiments designed by the gradient of what identification and calibration fit.

In reading order: `motions`, `sampling` (rows and their gradient), `information`, `limits`, `solvers`, `objectives`,
`separation` (causes told apart), `design`, `postures`, `task`.
"""
