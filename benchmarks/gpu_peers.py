"""Inverse and forward dynamics and the mass matrix of other libraries on an accelerator, beside ours, in one process.

    PYTHONPATH=. python benchmarks/gpu_peers.py ROBOT.urdf [--peers ours mjx frax] [--samples N ...] [--dtypes NAME ...]

Each peer's function is vmapped over random states that lie on the device and compiled as one program; its torques are
compared with Pinocchio's. A peer that is not installed is told and left out. For every peer the best of its batch
sizes counts.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

import figaroh_jax as fj

CHECKED, ROUNDS = 200, 7
Functions = dict[str, Callable[..., Any]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", type=Path, metavar="ROBOT.urdf")
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=list(PEERS))
    parser.add_argument("--samples", nargs="+", type=int, default=[1 << 14, 1 << 18])
    parser.add_argument("--dtypes", nargs="+", default=["float64", "float32"])
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}, {options.robot.stem}", flush=True)
    for peer in options.peers:
        for dtype in options.dtypes:
            try:
                functions = PEERS[peer](options.robot, dtype)
            except Exception as error:  # another library's: what it says is the finding
                print(f"{peer:5} {dtype}: does not run here: {type(error).__name__}: {str(error)[:200]}", flush=True)
                continue
            for name, function in functions.items():
                for line in _measure(options.robot, name, function, dtype, options.samples):
                    print(f"{peer:5} {dtype} {name:17} {line}", flush=True)


def _measure(robot: Path, name: str, function: Callable[..., Any], dtype: str, sizes: list[int]) -> Iterator[str]:
    model = pin.buildModelFromUrdf(str(robot))
    for samples in sizes:
        random = np.random.default_rng(0)
        q, v, a = random.uniform(-1.5, 1.5, (3, samples, model.nv))
        third = _torques(model, q, v, a) if name == "forward dynamics" else a
        state = [jnp.asarray(x, dtype) for x in (q, v, third)]
        try:
            begin = time.perf_counter()
            found = jax.block_until_ready(function(*state))
            first = time.perf_counter() - begin
            seconds = min(_seconds(function, state) for _ in range(ROUNDS))
        except Exception as error:
            yield f"{samples:8d} samples: {type(error).__name__}: {str(error)[:200]}"
            continue
        expected = _expected(model, name, q, v, third)
        off = np.abs(np.asarray(found[: len(expected)], float) - expected).max() / np.abs(expected).max()
        yield f"{samples:8d} samples {samples / seconds / 1e6:9.2f} M/s; first {first:6.2f} s; {off:.1e} from Pinocchio"


def _seconds(function: Callable[..., Any], state: list[Any]) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(function(*state))
    return time.perf_counter() - begin


def _torques(model: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Pinocchio's for the first states, which are compared; of the size of their largest for the others."""
    data, out = model.createData(), np.random.default_rng(1).standard_normal(v.shape)
    out[:CHECKED] = [pin.rnea(model, data, *x) for x in zip(q[:CHECKED], v[:CHECKED], a[:CHECKED], strict=True)]
    return out


def _expected(model: Any, name: str, q: np.ndarray, v: np.ndarray, third: np.ndarray) -> np.ndarray:
    data = model.createData()
    state = list(zip(q[:CHECKED], v[:CHECKED], third[:CHECKED], strict=True))
    if name == "inverse dynamics":
        return np.array([pin.rnea(model, data, *x) for x in state])
    if name == "forward dynamics":
        return np.array([pin.aba(model, data, *x) for x in state])
    upper = [np.triu(pin.crba(model, data, x[0])) for x in state]
    return np.array([x + np.triu(x, 1).T for x in upper])


def _ours(robot: Path, dtype: str) -> Functions:
    model = fj.load_urdf(robot)
    from figaroh_jax.compiled.kernels import straight_answers
    from figaroh_jax.rigid import dynamics

    def answers(form: Any, *arrays: Any) -> Any:
        return straight_answers(form, model, *arrays)

    forms = dynamics._TORQUES, dynamics._ACCELERATIONS, dynamics._MASSES
    torques, accelerations, masses = forms
    if dtype == "float64":
        return {
            "inverse dynamics": jax.jit(lambda q, v, a: fj.inverse_dynamics(model, q, v, a)),
            "forward dynamics": jax.jit(lambda q, v, tau: fj.forward_dynamics(model, q, v, tau)),
            "mass matrix": jax.jit(lambda q, v, a: fj.mass_matrix(model, q)),
        }
    return {
        "inverse dynamics": jax.jit(lambda q, v, a: answers(torques, q, v, a)),
        "forward dynamics": jax.jit(lambda q, v, tau: answers(accelerations, q, v, tau)),
        "mass matrix": jax.jit(lambda q, v, a: answers(masses, q)),
    }


def _mjx(robot: Path, dtype: str) -> Functions:
    import mujoco as engine  # pyright: ignore[reportMissingImports]
    from mujoco import mjx  # pyright: ignore[reportMissingImports]

    text = robot.read_text(encoding="utf-8")
    mujoco: Any = engine
    plain = mujoco.MjModel.from_xml_string(_without_meshes(text))
    plain.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    model = jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, mjx.put_model(plain)
    )
    blank = mjx.make_data(plain)
    blank = jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, blank)

    def torque(q: Any, v: Any, a: Any) -> Any:
        return mjx.inverse(model, blank.replace(qpos=q, qvel=v, qacc=a)).qfrc_inverse

    return {"inverse dynamics": jax.jit(jax.vmap(torque))}


def _without_meshes(text: str) -> str:
    """A URDF of the links' inertias and the joints alone, whose small inertias MuJoCo takes as they are."""
    root = ElementTree.fromstring(text)  # noqa: S314  the user's own file
    for link in root.iter("link"):
        for part in [x for x in link if x.tag in ("visual", "collision")]:
            link.remove(part)
    settings = {"fusestatic": "true", "balanceinertia": "false", "boundmass": "0", "discardvisual": "true"}
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", settings)
    return ElementTree.tostring(root, encoding="unicode")


def _frax(robot: Path, dtype: str) -> Functions:
    import frax  # pyright: ignore[reportMissingImports]

    model = frax.Robot(str(robot))
    up = jnp.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0], dtype)

    def torque(q: Any, v: Any, a: Any) -> Any:
        return model.rnea(q, v, a, up, None)

    return {
        "inverse dynamics": jax.jit(jax.vmap(torque)),
        "forward dynamics": jax.jit(jax.vmap(lambda q, v, tau: model.forward_dynamics(q, v, tau, None))),
        "mass matrix": jax.jit(jax.vmap(lambda q, v, a: model.mass_matrix(q))),
    }


PEERS = {"ours": _ours, "mjx": _mjx, "frax": _frax}

if __name__ == "__main__":
    main()
