"""Effects beyond the rigid body: `base` -> `catalogue`, `kinematic`; a robot with them: `extended`, `simulation`."""
