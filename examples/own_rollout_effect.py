"""An effect of your own where no torque is recorded: registered, hidden in MuJoCo's own simulation, and named from it.

A ball that drops into a notch as a servo's joint passes it. MuJoCo C does not know it either: there it is a torque that
a loop of Python applies (`qfrc_applied`). Run `python examples/own_rollout_effect.py`; half a minute, with `mujoco`.
"""

import tempfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco as engine
import numpy as np

import figaroh_jax as fj

mujoco: Any = engine
SERVO = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body pos="0 0 1">
<joint name="lift" axis="0 1 0" damping="0.4" armature="0.05" frictionloss="0.15"/>
<inertial pos=".15 0 .02" mass="1" diaginertia=".01 .02 .02"/></body></worldbody>
<actuator><position name="lift" joint="lift" kp="60" kv="2"/></actuator></mujoco>"""


@fj.register
class Detent(fj.JointEffect):
    """A ball that drops into a notch of the joint and has to be pushed out of it."""

    name, title, equation = "servo_detent", "a detent", "strength x exp(-x^2 / 2), x = (q - notch) / 0.1 rad"
    strength: float = fj.amplitude("N m")
    notch: float = fj.shape("rad", (-0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6))  # where a search begins

    def torque(self, motion: fj.Motion):
        x = (self.here(motion.position) - self.notch) / 0.1
        return self.strength * x * jnp.exp(-(x**2) / 2)


def recorded(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Command and position of 8 s in MuJoCo C with a notch of 1.5 N m at .15 rad; noise of .2 mrad."""
    model = mujoco.MjModel.from_xml_string(SERVO)
    data, t = mujoco.MjData(model), 0.002 * np.arange(4000)
    u, q = (0.5 * np.sin(2 * t) + 0.3 * np.sin(5.3 * t + 1)) * np.clip(t / 0.2, 0, 1), np.zeros(4000)
    for k, command in enumerate(u):
        q[k], data.ctrl[0] = data.qpos[0], command
        x = (q[k] - 0.15) / 0.1
        data.qfrc_applied[0] = -1.5 * x * np.exp(-(x**2) / 2)
        mujoco.mj_step(model, data)
    return {"t": t, "u": u, "q": q + 2e-4 * rng.standard_normal(4000)}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "servo.xml").write_text(SERVO.replace('damping="0.4"', 'damping="0.6"'))  # which no one knows
        np.savez(folder / "run.npz", **recorded(np.random.default_rng(1)))  # pyright: ignore
        columns = "{file: run.npz, time: t, command: u, position: q}"
        (folder / "task.yaml").write_text(f"robot: {{model: servo.xml}}\ndata:\n  - {columns}\n")
        found = fj.diagnose_task(fj.load_task(folder / "task.yaml"))
    for cause in found.causes:
        print(f"{found.verdict}: {cause.name}", {k: (round(e.value, 4), e.unit) for k, e in cause.parameters.items()})
