"""Sums on devices: the condensed data of the host, on one device or several, and for batches of robots."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from robots import ARM, TREE, load, states

import figaroh_jax as fj
from figaroh_jax.compiled import machine_code
from figaroh_jax.errors import InputError
from figaroh_jax.estimation import accelerators
from figaroh_jax.estimation.accelerators import condense_on_devices, coordinates, fit_states
from figaroh_jax.estimation.base_parameters import base_parameters
from figaroh_jax.estimation.columns import friction_terms
from figaroh_jax.estimation.least_squares import WeightedByJoint, solve
from figaroh_jax.estimation.regression import Condensed, condense
from figaroh_jax.estimation.states import States, read_pieces
from figaroh_jax.formats.config import Baseline

TESTS = Path(__file__).parent


def tree_states(folder: Path) -> States:
    """700 noisy states of a branched robot with a mimic and a sliding joint, in pieces of odd lengths."""
    model = load(TREE, folder)
    q, v, a = states(model, 700)
    noise = 0.1 * np.random.default_rng(1).normal(size=v.shape)
    tau = np.asarray(fj.inverse_dynamics(model, q, v, a)) + 2 * v + np.sign(v) + noise
    pieces = [tuple(x[k : k + 300] for x in (q, v, a, tau)) for k in range(0, 700, 300)]
    return States(model, lambda: pieces, friction_terms(model, Baseline(rotor=True, offset=True)))


def normal(condensed: Condensed, joints: np.ndarray | None = None) -> np.ndarray:
    R = condensed.factor(joints)
    return R.T @ R


def test_sums_on_a_device_are_the_factors_of_the_host(tmp_path: Path):
    rows = tree_states(tmp_path)
    host, device = condense(rows, rows.used), condense_on_devices(rows)
    for weight in [None, *np.eye(rows.model.nv)]:
        expected = normal(host, weight)
        np.testing.assert_allclose(normal(device, weight), expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    assert device.rows.tolist() == host.rows.tolist() == [700] * rows.model.nv
    np.testing.assert_allclose(device.torque.sum(0), host.torque.sum(0), rtol=0, atol=1e-9)
    found, expected = (base_parameters(x.factor()[:, :-1], rows.names) for x in (device, host))
    assert found.expressions == expected.expressions
    fits = [solve(x, WeightedByJoint(), kept=expected.independent).parameters for x in (device, host)]
    np.testing.assert_allclose(*fits, rtol=0, atol=1e-9)
    assert len(device.factors) == 5 and (device.count.sum(1) > 0).all()


def test_sums_of_machine_code_are_those_of_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Pieces that are no whole number of chunks, rows of terms computed a chunk at a time; the same folds."""
    if machine_code._compiler() is None or jax.default_backend() != "cpu":
        pytest.skip("no C compiler, or sums on a GPU")
    for name, value in {"FROM": 16, "TO_COMPILE": 16, "_ready": {}, "_store": lambda: None}.items():
        monkeypatch.setattr(machine_code, name, value)
    monkeypatch.setattr(accelerators, "CODE_CHUNK", 64)
    monkeypatch.setattr(accelerators, "TERMS_CHUNK", 128)
    rows = tree_states(tmp_path)
    code, program = condense_on_devices(rows), condense_on_devices(rows, chunk=64)
    for weight in [None, *np.eye(rows.model.nv)]:
        expected = normal(program, weight)
        np.testing.assert_allclose(normal(code, weight), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(code.count, program.count)
    np.testing.assert_allclose(code.torque, program.torque, rtol=0, atol=1e-9)


def test_a_motion_that_shows_less_has_a_lower_rank_on_a_device_too(tmp_path: Path):
    rows = tree_states(tmp_path)
    still = States(rows.model, lambda: [(q, 0 * v, 0 * a, tau) for q, v, a, tau in rows.source()], rows.terms)
    host, device = condense(still, rows.used), condense_on_devices(still)
    found, expected = (base_parameters(x.factor()[:, :-1], rows.names) for x in (device, host))
    assert found.expressions == expected.expressions
    assert found.rank < rows.structural.rank


SHARDED = """
import sys
from pathlib import Path
import jax, numpy as np
jax.config.update("jax_compilation_cache_dir", sys.argv[2])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
from test_devices import condense_on_devices, tree_states
rows = tree_states(Path(sys.argv[1]))
assert len(jax.devices()) == 3
one, three = (condense_on_devices(rows, devices, chunk=64) for devices in (jax.devices()[:1], None))
for weight in [None, *np.eye(rows.model.nv)]:
    first, second = (x.factor(weight).T @ x.factor(weight) for x in (one, three))
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-12 * np.abs(first).max())
assert one.rows.tolist() == three.rows.tolist() == [700] * rows.model.nv
"""


def test_three_devices_give_the_sums_of_one(tmp_path: Path):
    flags = "--xla_force_host_platform_device_count=3 " + os.environ.get("XLA_FLAGS", "")
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", SHARDED, str(tmp_path), str(TESTS.parent / ".cache" / "jax")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


HOSTS = """
import sys
from pathlib import Path
import jax, numpy as np
from test_devices import States, address, condense_on_devices, tree_states
folder, number = Path(sys.argv[1]), int(sys.argv[2])
jax.distributed.initialize(address(folder, number), num_processes=2, process_id=number)
own = folder / str(number)  # both come here at once: a file written by both would be empty for one that reads it
own.mkdir()
rows = tree_states(own)
pieces = list(rows.source())
own = States(rows.model, lambda: pieces[:1] if number == 0 else pieces[1:], rows.terms)
np.save(folder / f"factor{number}.npy", condense_on_devices(own).factor())
"""


def address(folder: Path, number: int) -> str:
    """Where process 0 listens: it takes a free port at the last moment, and says which."""
    told, patience = folder / "address", time.monotonic() + 200
    if number == 0:
        with socket.socket() as free:
            free.bind(("localhost", 0))
            (folder / "saying").write_text(f"localhost:{free.getsockname()[1]}")
        (folder / "saying").rename(told)
    while not told.exists():
        assert time.monotonic() < patience, "process 0 has not said where it listens"
        time.sleep(0.05)
    return told.read_text()


@pytest.mark.slow
def test_two_processes_with_pieces_of_their_own_give_the_sums_of_one(tmp_path: Path):
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    environment = os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"}
    rows = tree_states(tmp_path)
    # without the tests' programs: JAX takes one of the only process for a device that is another one's here
    command = [sys.executable, "-c", HOSTS, str(tmp_path)]
    starts = {"env": environment, "stderr": subprocess.PIPE, "text": True}
    running = [subprocess.Popen([*command, str(k)], **starts) for k in range(2)]
    try:
        said = [one.communicate(timeout=300)[1] for one in running]
    finally:
        for one in running:
            one.kill()
    assert [one.returncode for one in running] == [0, 0], said
    first, second = (np.load(tmp_path / f"factor{k}.npy") for k in range(2))
    np.testing.assert_array_equal(first, second)
    expected = normal(condense(rows, rows.used))
    np.testing.assert_allclose(first.T @ first, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.slow
def test_vmap_over_robots_and_their_trajectories_is_one_fit_after_another(tmp_path: Path):
    rows = tree_states(tmp_path)
    base, count = rows.structural, 3
    longer = np.asarray(rows.model.placement) * np.ones((count, 1, 1, 1))
    longer[:, :, :3, 3] *= np.array([1.0, 1.2, 0.7])[:, None, None]
    robots = eqx.tree_at(lambda m: m.placement, rows.model, longer)
    axes = eqx.tree_at(lambda m: m.placement, jax.tree.map(lambda _: None, rows.model), 0, is_leaf=lambda x: x is None)
    q, v, a = (x.reshape(count, 200, -1) for x in states(rows.model, count * 200))
    each = [eqx.tree_at(lambda m: m.placement, rows.model, placement) for placement in longer]
    tau = np.stack([np.asarray(fj.inverse_dynamics(m, *x)) for m, *x in zip(each, q, v, a, strict=True)]) + v
    tau += 0.1 * np.random.default_rng(3).normal(size=tau.shape)
    into = coordinates(rows.structure, base).into
    found = jax.jit(jax.vmap(fit_states, (axes, None, None, 0, 0, 0, 0)))(robots, rows.terms, into, q, v, a, tau)
    for k, model in enumerate(each):
        one = States(model, lambda k=k: [(q[k], v[k], a[k], tau[k])], rows.terms)
        expected = solve(condense(one, one.used), WeightedByJoint(iterations=2), kept=base.independent)
        np.testing.assert_allclose(found.parameters[k], expected.parameters, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.rms[k], expected.rms, rtol=1e-8)
        own = base_parameters(one.structure.reshape(-1, len(one.names)), one.names)
        truth = own.matrix @ np.concatenate([np.ravel(model.inertia), np.ones(model.nv), np.zeros(3 * model.nv)])
        score = (found.parameters[k][own.independent] - truth) / found.std[k][own.independent]
        assert np.sqrt(np.mean(score**2)) < 1.5


def test_numbers_that_are_not_finite_are_named(tmp_path: Path):
    rows = tree_states(tmp_path)
    pieces = [tuple(np.array(x) for x in part) for part in rows.source()]
    pieces[1][3][7, 2] = np.nan
    with pytest.raises(InputError, match="piece 1 of the source: tau is not finite in row 7, column 2"):
        condense_on_devices(States(rows.model, lambda: pieces, rows.terms))
    np.save(tmp_path / "q.npy", np.zeros((5, 2)))
    np.save(tmp_path / "v.npy", np.zeros((4, 2)))
    with pytest.raises(InputError, match="v.npy has shape .4, 2., expected 5 rows"):
        list(read_pieces([tmp_path / "q.npy", tmp_path / "v.npy"]))


PEAK = """
import sys
from pathlib import Path
import numpy as np
from figaroh_jax.estimation import accelerators
from figaroh_jax.estimation.accelerators import condense_on_devices
from figaroh_jax.estimation.states import States, read_pieces
from figaroh_jax.formats.urdf import load_urdf
folder = Path(sys.argv[1])
model = load_urdf(folder / "robot.urdf")
for name in ("short", "long"):
    files = [folder / f"{name}_{k}.npy" for k in range(4)]
    rows = States(model, lambda: read_pieces(files))
    condensed = condense_on_devices(rows)
    status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    print(int(status["VmHWM"].split()[0]) // 1024, int(condensed.rows[0]))
"""


@pytest.mark.slow
def test_memory_is_the_same_for_twenty_times_the_samples_from_disk(tmp_path: Path):
    """Peak resident memory in MB: the long files hold 26 MB, their columns 130."""
    model, random = load(ARM, tmp_path), np.random.default_rng(0)
    for name, samples in {"short": 20_000, "long": 400_000}.items():
        for k in range(4):
            np.save(tmp_path / f"{name}_{k}.npy", random.standard_normal((samples, model.nv)))
    environment = os.environ | {"PYTHONPATH": str(TESTS.parent), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", PEAK, str(tmp_path)], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (small, few), (large, many) = (map(int, line.split()) for line in done.stdout.splitlines())
    assert (few, many) == (20_000, 400_000)
    assert large - small < 20


def test_a_fleet_is_one_robot_after_another_and_who_differs_stands_out(tmp_path: Path):
    """Twelve robots; spread of friction beside noise; one with three times the friction at its second joint."""
    rows, random = tree_states(tmp_path), np.random.default_rng(5)
    q, v, a = np.stack([states(rows.model, 200, seed=k) for k in range(12)], axis=1)
    friction = 2.0 + 0.2 * random.standard_normal((12, 1, rows.model.nv))
    friction[7, 0, 1] = 6.0
    rigid = np.stack([fj.inverse_dynamics(rows.model, *state) for state in zip(q, v, a, strict=True)])
    tau = rigid + friction * v + 0.01 * random.standard_normal(v.shape)
    fleet = fj.fleets.identify_fleet([rows.model] * 12, rows.terms, q, v, a, tau)
    base = rows.structural
    own = States(rows.model, lambda: [(q[3], v[3], a[3], tau[3])], rows.terms)
    alone = solve(condense(own, own.used), WeightedByJoint(), kept=base.independent).parameters[base.independent]
    np.testing.assert_allclose(fleet.parameters[3], alone, rtol=0, atol=1e-3 * np.abs(alone).max())
    viscous = [k for k, name in enumerate(fleet.names) if name.startswith("fv")]
    found = fleet.unusual()
    assert found[:, viscous].sum() == 1 and found[7].sum() >= 1
    ordinary = np.delete(fleet.spread[viscous], np.argmax(fleet.spread[viscous]))
    np.testing.assert_allclose(ordinary, 0.2, rtol=0.6)
    with pytest.raises(InputError, match="tau has shape"):
        fj.fleets.identify_fleet([rows.model] * 12, rows.terms, q, v, a, tau[:, :, :2])
