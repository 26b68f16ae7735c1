"""The robot and its mechanics: `spatial`, `lie`, `inertia`, `model` -> `kinematics` -> `dynamics`, `regressor`."""
