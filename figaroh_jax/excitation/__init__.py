"""Motions, postures and experiments designed by the gradient of what identification and calibration fit.

In reading order: `motions`, `information`, `sampling`, `limits`, `solvers`, `separation`, `design`, `postures`.
"""
