"""What a motion tells about a robot: the information on its base parameters and friction, and what follows from it.

The rows are those that identification fits: the regressor of the rigid body and the columns of the friction, divided by
the noise of each joint. All here are functions of the parameters of a motion for `jit`, `grad` and `vmap`; `learn`,
which chooses what is to be learned, works on the host.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiled.batching import program
from ..compiled.precision import in_float64
from ..effects.base import Effect
from ..effects.extended import ExtendedModel, require_single_axes
from ..errors import InputError, check_finite, check_kind, check_positive, check_real, nearest
from ..estimation.base_parameters import base_parameters
from ..estimation.columns import column_names, friction_terms, random_states
from ..estimation.priors import rigid_prior
from ..rigid.dynamics import inverse_dynamics
from ..rigid.model import Leaf, RobotModel
from ..rigid.regressor import joint_torque_regressor
from .motions import Trajectory
from .sampling import Sampler, term_blocks

if TYPE_CHECKING:
    from ..formats.config import Baseline

__all__ = ["Learned", "expected_std", "information", "information_matrix", "learn"]

SMOOTH = 0.03  # rad/s or m/s: half width of dry friction's reversal, so that its columns have a gradient
UNKNOWN_DRIVE = 1e-6  # precision of what nothing is known of, 1/(N m)^2 and the like

States = tuple[Any, Any, Any]


class Learned(eqx.Module):
    """What is to be learned of a robot, how noisy its torques are, and what is known before."""

    robot: RobotModel
    terms: tuple[Effect, ...]  # friction and the like, with a leading axis of their joints
    weight: Float[Leaf, " nv"]  # inverse variance of a sample of each joint's torque
    prior: Float[Leaf, "rank rank"]  # information before any motion
    width: Float[Leaf, " nv"]  # half width of dry friction's reversal, rad/s or m/s
    theta: Float[Leaf, " columns"]  # what the torques of the model as it stands follow from
    names: tuple[str, ...] = eqx.field(static=True)  # of all columns
    independent: tuple[int, ...] = eqx.field(static=True)  # the columns that are kept
    expressions: tuple[str, ...] = eqx.field(static=True)  # base parameters in names
    held: tuple[int, ...] = eqx.field(static=True, default=())  # coordinates that stand still

    def __repr__(self) -> str:
        names = ", ".join(self.names[k] for k in self.independent)
        return f"Learned: {self.rank} base parameters of '{self.robot.name}': {names}"

    @property
    def rank(self) -> int:
        """Number of base parameters, friction with them."""
        return len(self.independent)

    def with_prior(self, information: Float[Leaf, "rank rank"]) -> Learned:
        """The same after an experiment of this information."""
        return eqx.tree_at(lambda one: one.prior, self, self.prior + information)

    def with_noise(self, sigma: Float[Leaf, " nv"]) -> Learned:
        """The same with other standard deviations of the torques, N m or N."""
        return eqx.tree_at(lambda one: one.weight, self, 1 / np.asarray(sigma) ** 2)


def learn(
    model: RobotModel | ExtendedModel,
    known: Baseline | None = None,
    *,
    noise: float | Mapping[str, float] = 0.01,
    sigma: Sequence[float] | np.ndarray | None = None,
    trust: float | None = 0.10,
    order: Sequence[int] | None = None,
    width: float = SMOOTH,
    measured: Mapping[str, float] | None = None,
    hold: Sequence[str] = (),
) -> Learned:
    """Base parameters of the robot and of its friction, weighted by the noise of the torques.

    `known` says which friction there is (default: viscous and Coulomb); `noise` is one sigma of a sample, as a share of
    each joint's largest torque (`effort_limit` of the model, or what typical motions take where it has none), `sigma`
    the same in N m or N; `trust` how far the nominal inertials are believed (relative one sigma), None for not at all;
    `order` prefers columns in the choice of base parameters. `measured`: the only joints whose torque is measured, with
    one sigma each (N m or N), as the plate under a person (`people.standing`), and links without a mass have none to be
    learned; `hold`: joints that stand still. Raises
    `InputError` for a robot with joints of several degrees of freedom and for joints that are not there.

    >>> import figaroh_jax as fj
    >>> learned = fj.learn(fj.load_urdf(fj.DEMO), noise={"waist": 1.0, "shoulder": 1.0, "elbow": 0.5, "wrist": 0.2})
    >>> learned.rank == len(learned.expressions) <= len(learned.names)  # base parameters, columns
    True
    """
    from ..formats.config import Baseline

    check_kind("model", model, (RobotModel, ExtendedModel), "load_urdf reads one")
    check_kind("known", known or Baseline(), Baseline, "Baseline(viscous=True), say")
    if trust is not None:
        check_positive("trust", trust, "relative one sigma")
    check_finite("width", width, 0.0)
    if sigma is not None:
        check_real("sigma", sigma)
    robot, effects = (model.robot, model.effects) if isinstance(model, ExtendedModel) else (model, ())
    require_single_axes(robot, "a motion that is designed")
    terms = friction_terms(robot, known or Baseline())
    names = column_names(robot, terms)
    sampler = Sampler(robot, terms, np.full(robot.nv, width))
    samples = max(64, 4 * len(names) // robot.nv)
    held = np.array([_column(robot, "hold", name) for name in hold], int)
    rows = [_column(robot, "measured", name) for name in measured] if measured else list(range(robot.nv))
    states = np.stack(random_states(robot, samples * (robot.nv // len(rows))))
    states[:, :, held] = 0.0
    structure = sampler.rows(states)[rows]  # what any motion at all could show
    if measured:  # a link that has no mass, between two axes of a joint, is none
        structure[:, np.repeat(np.asarray(robot.inertia)[:, 0] <= 0, 10).nonzero()[0]] = 0.0
    base = base_parameters(structure.swapaxes(1, 2).reshape(-1, len(names)), names, order)
    own = 10 * len(robot.joints)
    scale = _sigmas(robot, noise) if sigma is None else np.asarray(sigma, float)
    if scale.shape != (robot.nv,) or not (scale > 0).all():
        raise InputError(f"noise: {robot.nv} standard deviations above zero are needed, one for each joint")
    if measured:
        scale = np.full(robot.nv, np.inf)
        scale[rows] = list(measured.values())
        if not (scale[rows] > 0).all():
            raise InputError("measured: each joint needs one sigma above zero")
    prior = np.zeros((base.rank, base.rank))
    if trust is not None:
        precision = np.append(rigid_prior(robot, trust)[1], np.full(len(names) - own, UNKNOWN_DRIVE))
        prior = np.linalg.inv((base.matrix / precision) @ base.matrix.T)
    return Learned(
        robot=robot,
        terms=terms,
        weight=1 / scale**2,
        prior=(prior + prior.T) / 2,
        width=np.full(robot.nv, width),
        theta=np.append(np.asarray(robot.inertia, float).ravel(), _drives(terms, effects)),
        names=names,
        independent=tuple(base.independent.tolist()),
        expressions=base.expressions,
        held=tuple(held.tolist()),
    )


def _column(robot: RobotModel, key: str, name: str) -> int:
    if name not in robot.dof_names:
        raise InputError(f"{key}: no moving joint '{name}'{nearest(name, robot.dof_names)}")
    return robot.dof_names.index(name)


def _sigmas(robot: RobotModel, noise: float | Mapping[str, float]) -> Float[np.ndarray, " nv"]:
    """One sigma of each joint's torque, N m or N."""
    largest = np.array(robot.effort_limit, float)
    if not (np.isfinite(largest) & (largest > 0)).all():
        typical = np.abs(np.asarray(inverse_dynamics(robot, *random_states(robot, 256)))).max(axis=0)
        largest = np.where(np.isfinite(largest) & (largest > 0), largest, typical)
    for one in noise.values() if isinstance(noise, Mapping) else [noise]:
        check_positive("noise", one, "relative one sigma")
    if not isinstance(noise, Mapping):
        return float(noise) * largest
    for name in noise:
        if name not in robot.dof_names:
            raise InputError(f"noise: no moving joint '{name}'{nearest(name, robot.dof_names)}")
    missing = [name for name in robot.dof_names if name not in noise]
    if missing:
        raise InputError(f"noise: {', '.join(missing)} missing; give each joint's, or one number for all")
    return np.array([noise[name] for name in robot.dof_names]) * largest


def _drives(terms: Sequence[Effect], effects: Sequence[Effect]) -> Float[np.ndarray, " drives"]:
    """Amplitudes that the model's own effects give the columns of `terms`; zero where it has none."""
    values: list[float] = []
    for term in terms:
        for at in np.asarray(term.at):
            same = [e for e in effects if type(e) is type(term) and np.array_equal(np.asarray(e.at), at)]
            linear = term.amplitudes()
            values += [sum(float(getattr(e, name)) for e in same) for name in linear]
    return np.array(values)


def _states(motion: Trajectory | States, rate: float) -> States:
    if isinstance(motion, Trajectory):
        return motion.states(rate)
    if not isinstance(motion, (tuple, list)) or len(motion) != 3:
        raise InputError(f"motion is of type {type(motion).__name__}; a Trajectory or three arrays q, v, a are needed")
    return motion


@in_float64
def information_matrix(learned: Learned, motion: Trajectory | States, rate: float = 20.0) -> Float[Array, "rank rank"]:
    """Information on the base parameters: of the motion, sampled at `rate` (Hz) with independent noise, and before it.

    `motion` is a `Trajectory`, or its arrays q, v, a of shape (samples, nv).
    """
    check_kind("learned", learned, Learned, "`learn(model)` makes one")
    check_positive("rate", rate, "Hz")
    return _gram(learned, *(jnp.asarray(x) for x in _states(motion, rate))) + jnp.asarray(learned.prior)


@program
def _gram(
    learned: Learned, q: Float[Array, "samples nv"], v: Float[Array, "samples nv"], a: Float[Array, "samples nv"]
) -> Float[Array, "rank rank"]:
    W = jnp.concatenate(
        [
            joint_torque_regressor(learned.robot, q, v, a),
            *term_blocks(learned.robot, learned.terms, learned.width, q, v, a),
        ],
        axis=2,
    )[:, :, np.array(learned.independent)]
    return jnp.einsum("sjk,j,sjl->kl", W, jnp.asarray(learned.weight), W)


@in_float64
def information(
    model: RobotModel, motion: Trajectory | States, learned: Learned | None = None, rate: float = 20.0
) -> Float[Array, ""]:
    """Log determinant of the information on the base parameters and friction: what a design makes as large as it can.

    A pure function of the parameters of the motion. An increase by 1 makes the geometric mean of the standard
    deviations smaller by the factor exp(-1 / (2 rank)). `learned` None: as `learn(model)` has it, which needs a model
    that is not being traced.

    >>> import jax, numpy as np, figaroh_jax as fj
    >>> robot, basis = fj.load_urdf(fj.DEMO), fj.spline(4, duration=3.0)
    >>> learned = fj.learn(robot)
    >>> of = lambda size: fj.information(robot, fj.Trajectory(np.zeros(4), size * np.ones((4, 4)), basis), learned)
    >>> bool(of(0.3) > of(0.1)), bool(jax.grad(of)(0.1) > 0)  # larger motions tell more
    (True, True)
    """
    check_kind("model", model, (RobotModel, ExtendedModel), "information(model, motion, learned)")
    matrix = information_matrix(learn(model) if learned is None else learned, motion, rate)
    return 2.0 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(matrix))))


@in_float64
def expected_std(learned: Learned, motion: Trajectory | States, rate: float = 20.0) -> Float[Array, " rank"]:
    """Standard deviation of each base parameter (its unit) after a fit to the motion and to what was known before.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> learned, motion = fj.learn(robot), fj.Trajectory(np.zeros(4), 0.3 * np.ones((4, 4)), fj.spline(4, duration=3.0))
    >>> once, twice = (fj.expected_std(learned, motion, rate=rate) for rate in (20.0, 40.0))
    >>> bool((twice < once).all())
    True
    """
    return jnp.sqrt(jnp.diagonal(jnp.linalg.inv(information_matrix(learned, motion, rate))))
