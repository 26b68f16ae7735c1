"""The recordings of a diagnosis and what is believed of the robot before: fixed from its beginning to its end."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from itertools import pairwise
from typing import Any, Generic, NamedTuple, TypeVar
from weakref import ref

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ..effects.base import Effect, Motion
from ..effects.catalogue import CATALOGUE
from ..estimation.joint_rows import JointRows
from ..estimation.priors import rigid_prior
from ..estimation.rows import Rows
from ..recordings.stacked import Records, filter_rows, open_rows
from ..rigid.model import RobotModel
from ..rigid.regressor import coordinate_blocks, packed_regressor
from ..simulators.contract import Backend
from .comparison import FoldSums, Verdicts, fold_sums, grown_sums, prefix_sums
from .design import SHORT, Units, candidates, flattened, kind, shapes, units
from .shifts import links_torque, rigid_torque
from .thresholds import TRUSTED

T = TypeVar("T")

__all__ = ["Layout", "Part", "Problem", "family_of", "without_factor"]

# cached, and the same for all weights of the rows
_OF_THE_MOTION = ("torque", "read", "reached", "gain", "passed", "motion", "families", "fixed", "plain", "_terms")
KEPT = 64 << 20  # bytes of filtered columns that are held: three responses of an arm in 18 recordings of half a minute
AT_ONCE = 6  # effects with a shape that are evaluated at once along long recordings
MOST_SUMS = 12  # models whose normal equations are held
MOST_BEGUN, MOST_JUDGED = 4, 16
MOST_TERMS = 48  # terms of models whose columns are held
TURNED = 128  # samples that are turned at once: they stay in the processor's cache


class _Columns(NamedTuple):
    """Columns at all samples, without those that are zero, each at one joint."""

    series: Float[np.ndarray, "series nN"]  # by joint, then by column
    joint: Int[np.ndarray, " series"]
    column: Int[np.ndarray, " series"]


class Part:
    """Columns of a regressor at all samples, without the zeros: a tree leaves many joints of a column untouched.

    They are made when they are first asked for: `quick` is their torque by another way, all that many models need.
    """

    def __init__(
        self,
        make: Callable[[], _Columns],
        shape: tuple[int, int, int],
        quick: Callable[[Float[np.ndarray, " k"]], Float[np.ndarray, "nN nv"]] | None = None,
    ) -> None:
        self._make, self._quick = make, quick
        self.samples, self.nv, self.width = shape  # samples of all recordings, coordinates, columns
        self._last: list[tuple[np.ndarray, np.ndarray]] = []  # coefficients and their torque

    @cached_property
    def _columns(self) -> _Columns:
        return self._make()

    @property
    def series(self) -> Float[np.ndarray, "series nN"]:
        """The columns that are not zero, by joint, then by column."""
        return self._columns.series

    @property
    def joint(self) -> Int[np.ndarray, " series"]:
        """Joint of each of `series`."""
        return self._columns.joint

    @property
    def column(self) -> Int[np.ndarray, " series"]:
        """Column of each of `series`."""
        return self._columns.column

    @classmethod
    def of(cls, columns: Float[np.ndarray, "nv k nN"]) -> Part:
        """The part of columns as they are."""
        joint, column = np.nonzero(columns.any(2))
        made = _Columns(columns[joint, column], joint, column)
        return cls(lambda: made, (columns.shape[2], *columns.shape[:2]))

    @classmethod
    def of_series(
        cls,
        series: Float[np.ndarray, "series nN"],
        joint: Int[np.ndarray, " series"],
        column: Int[np.ndarray, " series"],
        shape: tuple[int, int],
    ) -> Part:
        """The part of columns each at one joint, in any order; `shape` are coordinates and columns."""
        order = np.lexsort((column, joint))
        order = order[np.asarray(series.any(1))[order]]
        made = _Columns(series[order], joint[order], column[order])
        return cls(lambda: made, (series.shape[1], *shape))

    @classmethod
    def of_samples(cls, columns: Float[np.ndarray, "nN nv k"]) -> Part:
        """The part of columns that lie sample by sample."""
        joint, column = np.nonzero(columns.any(0))
        series = np.empty((len(joint), len(columns)))
        for start in range(0, len(columns), TURNED):
            few = slice(start, start + TURNED)
            series[:, few] = columns[few][:, joint, column].T
        made = _Columns(series, joint, column)
        return cls(lambda: made, columns.shape)

    @classmethod
    def of_rigid(cls, model: RobotModel, motion: Sequence[Float[np.ndarray, "nN nv"]]) -> Part:
        """Ten columns a link along a motion, each joint a coordinate of its own; their torque by inverse dynamics."""

        def make() -> _Columns:
            blocks, (where, place) = np.asarray(packed_regressor(model, *motion)), coordinate_blocks(model.joints)
            order = np.argsort(place)  # recordings may have their columns in another order than the tree
            return _of_blocks(blocks if (np.diff(order) > 0).all() else blocks[order], where)

        def quick(theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, "nN nv"]:
            return rigid_torque(eqx.tree_at(lambda m: m.inertia, model, theta.reshape(-1, 10)), *motion)

        return cls(make, (len(motion[0]), model.nv, 10 * len(model.joints)), quick)

    def times(self, factor: Float[np.ndarray, " nN"], joint: int) -> Part:
        """The columns of one joint, each sample times a factor; the other joints' are zero."""
        made = self._columns
        own = slice(*np.searchsorted(made.joint, (joint, joint + 1)).tolist())
        some = _Columns(made.series[own] * factor, made.joint[own], made.column[own])
        return Part(lambda: some, (self.samples, self.nv, self.width))

    def torque(self, theta: Float[np.ndarray, " k"], rows: slice = slice(None)) -> Float[np.ndarray, "rows nv"]:
        """Torque (samples, nv) of the coefficients `theta`, N m or N; `rows` are samples."""
        if rows != slice(None):
            return self._of_columns(theta, rows)
        if not self._last or not np.array_equal(self._last[0][0], theta):
            torque = self._of_columns(theta, rows) if self._quick is None else self._quick(theta)
            torque.setflags(write=False)
            self._last[:] = [(theta.copy(), torque)]  # states that grow out of one another ask for it again
        return self._last[0][1]

    def _of_columns(self, theta: Float[np.ndarray, " k"], rows: slice) -> Float[np.ndarray, "rows nv"]:
        torque = np.zeros((len(range(self.samples)[rows]), self.nv))
        self.add(theta, torque, rows)
        return torque

    def add(
        self, theta: Float[np.ndarray, " k"], torque: Float[np.ndarray, "rows nv"], rows: slice = slice(None)
    ) -> None:
        """Add the torque of the coefficients to a `torque`, at the joints that have any of it."""
        series = self.series[:, rows]
        for joint, own in self.stretches:
            torque[:, joint] += theta[self.column[own]] @ series[own]

    @cached_property
    def stretches(self) -> list[tuple[int, slice]]:
        """The joints that have any of `series`, and where these stand."""
        ends = np.searchsorted(self.joint, np.arange(self.nv + 1)).tolist()
        return [(joint, slice(a, b)) for joint, (a, b) in enumerate(pairwise(ends)) if b > a]

    @cached_property
    def spans(self) -> list[tuple[int, slice, slice]]:
        """Side by side, each joint's columns from its first to its last: the joint, their places, the columns."""
        out, end = [], 0
        for joint, own in self.stretches:
            first, last = int(self.column[own].min()), int(self.column[own].max())
            out.append((joint, slice(end, end + last + 1 - first), slice(first, last + 1)))
            end = out[-1][1].stop
        return out

    def dense(self, columns: range) -> Float[np.ndarray, "k nv nN"]:
        """Some of the columns in the rows of all joints."""
        out = np.zeros((len(columns), self.nv, self.samples))
        own = np.flatnonzero((self.column >= columns.start) & (self.column < columns.stop))
        out[self.column[own] - columns.start, self.joint[own]] = self.series[own]
        return out


def _of_blocks(blocks: Float[np.ndarray, "pairs 10 nN"], where: Int[np.ndarray, "pairs 2"]) -> _Columns:
    """Ten columns for each coordinate and link that the tree does not make zero, in order of the coordinates."""
    flat = blocks.reshape(-1, blocks.shape[2])
    used = np.asarray(flat[:, :TURNED].any(1))
    used[~used] = flat[~used].any(1)
    joint, first = np.repeat(where, 10, axis=0).T
    column = 10 * first + np.tile(np.arange(10), len(where))
    return _Columns(flat if used.all() else flat[used], joint[used], column[used])


class _Made(NamedTuple):
    """Of which filtered columns rows were made, with what weights, and their products fold by fold."""

    blocks: list[tuple[ref[np.ndarray], int]]  # and the columns of each part
    weight: ref[Any]
    factor: Float[np.ndarray, " nv"]
    fold: ref[np.ndarray]
    gram: Float[np.ndarray, "folds P P"]

    def shared(self, other: _Made) -> int:
        """How many of the first columns are the same, and weighted alike, as those of another."""
        if self.weight() is not other.weight() or self.fold() is not other.fold():
            return 0
        count = 0
        for (own, width), (its, _) in zip(self.blocks, other.blocks, strict=False):
            if own() is None or own() is not its():
                break
            count += width
        return count if np.array_equal(self.factor, other.factor) else 0


class Filtered:
    """Parts of regressors through the row filter and a response, kept while they are used: most stay the same."""

    def __init__(self) -> None:
        self._last: tuple[ref[JointRows], list[tuple[ref[np.ndarray], int]], ref[Any], np.ndarray] | None = None
        self._sums: list[_Made] = []  # the last few
        # filtered columns by the addresses of the series and of the filter, as long as these live, and by the response
        self._kept: OrderedDict[tuple[int, int, bytes], tuple[ref[Any], ref[Any], np.ndarray]] = OrderedDict()

    def rows(
        self, records: Records, parts: Sequence[Part], response: Complex[np.ndarray, "F nv"] | Float[np.ndarray, "F nv"]
    ) -> JointRows:
        """Masked rows of the parts side by side."""
        response, factor = without_factor(response)
        code = blake2b(np.ascontiguousarray(response).tobytes(), digest_size=16).digest()
        code += np.asarray(records.weight).any((1, 2)).tobytes()
        blocks = [self._block(records, part, response, code) for part in parts]
        weight = (np.moveaxis(np.asarray(records.weight), 2, 0) * factor[:, None, None]).reshape(len(factor), -1, 1)
        X = _beside(parts, blocks, weight)
        made = [(ref(block), part.width) for block, part in zip(blocks, parts, strict=True)]
        self._last = ref(X), made, ref(records.weight), factor
        return X

    def sums(self, rows: Rows) -> FoldSums:
        """`fold_sums` of rows just made; products of columns that the rows of an earlier model began with are known."""
        if self._last is None or self._last[0]() is not rows.X:
            return fold_sums(rows, rows.X)
        made = _Made(*self._last[1:], ref(rows.fold), np.zeros(0))
        count, known = max(((one.shared(made), k) for k, one in enumerate(self._sums)), default=(0, 0))
        if count:
            first = prefix_sums(rows, self._sums[known].gram[:, :count, :count])
            sums = grown_sums(rows, first, rows.X.after(count))
        else:
            sums = fold_sums(rows, rows.X)
        self._sums = [made._replace(gram=sums.gram), *self._sums[: MOST_SUMS - 1]]
        return sums

    def _block(self, records: Records, part: Part, response: np.ndarray, code: bytes) -> Float[np.ndarray, "T places"]:
        source = np.asarray(records.source)
        key = (id(part.series), id(source), code)
        known = self._kept.pop(key, None)
        if known is not None and known[0]() is part.series and known[1]() is source:
            self._kept[key] = known
            return known[2]
        block = _through(records, part, response)
        self._kept[key] = ref(part.series), ref(source), block
        for old in [k for k, (one, other, _) in self._kept.items() if one() is None or other() is None]:
            del self._kept[old]
        while len(self._kept) > 1 and sum(own.nbytes for _, _, own in self._kept.values()) > KEPT:
            self._kept.popitem(last=False)
        return block


def _beside(
    parts: Sequence[Part], blocks: Sequence[Float[np.ndarray, "T _"]], weight: Float[np.ndarray, "nv T 1"]
) -> JointRows:
    """The filtered parts side by side, each row times its weight."""
    firsts = np.cumsum([0, *(part.width for part in parts)])
    found: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in weight]
    for part, block, first in zip(parts, blocks, firsts, strict=False):
        for joint, own, columns in part.spans:
            found[joint].append((block[:, own], np.arange(first + columns.start, first + columns.stop)))
    out = []
    for factor, own in zip(weight, found, strict=True):
        place = np.concatenate([at for _, at in own] or [np.zeros(0, int)])
        X = np.empty((len(factor), len(place)))
        ends = np.cumsum([len(at) for _, at in own])
        for (block, at), end in zip(own, ends, strict=True):
            np.multiply(block, factor, out=X[:, end - len(at) : end])
        out.append((X, place))
    return JointRows(out, int(firsts[-1]))


def without_factor(response: np.ndarray) -> tuple[np.ndarray, Float[np.ndarray, " nv"]]:
    """The response and a factor of each joint's rows: a response that no frequency changes is all factor."""
    if np.iscomplexobj(response) or not (response == response[:1]).all():
        return response, np.ones(response.shape[1])
    return np.ones_like(response), response[0]


def _through(records: Records, part: Part, response: np.ndarray) -> Float[np.ndarray, "T places"]:
    """A part through the row filter and the response, each series at its place in `Part.spans`."""
    n, samples, count, nv = records.shape
    rows = filter_rows(
        records, part.series.reshape(len(part.series), n, samples), response.T, fitted=True, of=part.joint
    )
    first = np.zeros(nv, int)
    for joint, own, columns in part.spans:
        first[joint] = own.start - columns.start
    block = np.zeros((n * count, part.spans[-1][1].stop if part.spans else 0))
    block[:, first[part.joint] + part.column] = rows.reshape(len(rows), n * count).T
    return block


class Known(Generic[T]):
    """The last few answers, each known by the objects that it was asked about."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._answers: OrderedDict[tuple[int, ...], tuple[tuple[object, ...], T]] = OrderedDict()

    def get(self, *about: object) -> T | None:
        """The answer about these very objects."""
        known = self._answers.get(tuple(map(id, about)))
        return None if known is None else known[1]

    def put(self, answer: T, *about: object) -> T:
        """Keep an answer, and the objects with it: their addresses are then no others'."""
        self._answers[tuple(map(id, about))] = about, answer
        while len(self._answers) > self._most:
            self._answers.popitem(last=False)
        return answer

    def clear(self) -> None:
        """Forget all answers."""
        self._answers.clear()


class Layout(eqx.Module):
    """Which rows repeat, belong together or are left out together; T = recordings x rows."""

    partner: Int[np.ndarray, "partners T"]
    paired: Float[np.ndarray, "nv T"]
    block: Int[np.ndarray, " T"]
    fold: Int[np.ndarray, " T"]  # by which causes are chosen: excitations, or slices in turn where they are few
    part: Int[np.ndarray, " T"]  # by which the gain is told: excitations, or quarters that follow one another
    repeats: bool = eqx.field(static=True)
    changed: Int[np.ndarray, " T"] | None = None  # row of a recording alike but for its torque, or -1


@dataclass(frozen=True)
class Problem:
    """Recordings and what is believed of the robot before; rows that are not fitted have no weight.

    The torque of the robot's rigid body, and its regressor, are the backend's; what an effect adds to them is ours.
    """

    backend: Backend
    records: Records
    layout: Layout
    trust: float
    width: Float[np.ndarray, " nv"]  # half width of the friction's reversal, rad/s or m/s
    held: Float[np.ndarray, "n M nv"]  # 1: a row of a holdout recording with torque
    names: tuple[str, ...] = ()  # of the recordings
    bounded: bool = False  # whether the links stay within what is believed of them (`believed`)
    filtered: Filtered = field(default_factory=Filtered, compare=False, repr=False)
    # states with the first causes of a fit, and what was said of a fit without one of them
    begun: Known[Any] = field(default_factory=lambda: Known(MOST_BEGUN), init=False, compare=False, repr=False)
    judged: Known[Verdicts] = field(default_factory=lambda: Known(MOST_JUDGED), init=False, compare=False, repr=False)

    @property
    def model(self) -> RobotModel:
        """The robot."""
        return self.backend.robot

    def weighted(self, weight: Float[np.ndarray, "n M nv"]) -> Problem:
        """The problem with other weights of its rows; what the motion alone says is not computed anew."""
        other = replace(self, records=eqx.tree_at(lambda r: r.weight, self.records, weight))
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k in _OF_THE_MOTION})
        return other

    @cached_property
    def torque(self) -> Float[np.ndarray, "n M nv"]:
        """Rows of the measured torque, not whitened, also those that are not fitted, N m or N."""
        return open_rows(self.records, self.records.flat(self.records.torque), np.ones(len(self.records.omega)))

    @cached_property
    def read(self) -> Part:
        """The measured torque at all samples as one column."""
        return Part.of(self.records.flat(self.records.torque).T[:, None])

    @cached_property
    def reached(self) -> tuple[Float[np.ndarray, " nq"], Float[np.ndarray, " nq"]]:
        """The lowest and the highest of each position, rad or m."""
        position = np.asarray(self.records.position)
        return position.min((0, 1)), position.max((0, 1))

    @cached_property
    def gain(self) -> Float[np.ndarray, " F"]:
        """Power gain of the row filter."""
        return np.asarray(self.records.low_pass) ** 2

    @cached_property
    def passed(self) -> float:
        """Share of white noise's power that the row filter passes: so many of the rows are independent."""
        frequency = np.linspace(0, float(self.records.rate) / 2, 400)
        return float(np.interp(frequency, np.asarray(self.records.omega) / (2 * np.pi), self.gain).mean())

    @cached_property
    def motion(self) -> Motion:
        """All samples of all recordings as measured, with the load of the nominal robot and of what it carries."""
        r = self.records
        q, v, a = (r.flat(x) for x in (r.position, r.velocity, r.acceleration))
        load = np.asarray(self.backend.inverse_dynamics(q, v, a))
        if r.carried is not None:
            load = load + links_torque(self.model, q, v, a, r) - rigid_torque(self.model, q, v, a)
        return Motion(self.model, r.flat(r.time), q, v, a, load, load, r.dt, self.width)

    @cached_property
    def believed(self) -> Float[np.ndarray, " P"]:
        """Precision of the links' inertial parameters as the task states it."""
        return rigid_prior(self.model, self.trust)[1]

    @cached_property
    def families(self) -> dict[str, dict[str, Effect]]:
        """Candidates of the whole catalogue (leading axes places, grid), by what their torque depends on.

        The equations of a family are one program: `fixed` by the measured motion alone, `shaped` (those that have a
        shape to search too), `following` the current model's torque, `sensor` through the rigid body or the filter.
        """
        out: dict[str, dict[str, Effect]] = {name: {} for name in ("fixed", "shaped", "following", "sensor", "link")}
        measured = eqx.tree_at(lambda m: m.total, self.motion, self.records.flat(self.records.torque))
        for name, effect in CATALOGUE.items():
            batch = candidates(effect, self.model, measured)
            if batch.at.shape[0]:
                out[family_of(effect)][name] = batch
        return out

    @cached_property
    def fixed(self) -> dict[str, Units]:
        """Unit torques of the effects that depend on the measured motion alone."""
        return self._family("fixed")

    @cached_property
    def plain(self) -> dict[str, tuple[Float[np.ndarray, "e k r n M"], Int[np.ndarray, "e r"]]]:
        """Rows, neither whitened nor weighted, of the effects that depend on the measured motion alone, and joints."""
        n, samples, _, _ = self.records.shape
        left = {n: b for n, b in self.families["shaped"].items() if n not in self.unturned}
        wanted, out = {name: np.ones(np.size(b.at[..., 0]), bool) for name, b in left.items()}, {}
        for given in [self.fixed, *self.shaped_in_parts(wanted)]:
            for name, own in given.items():
                torque = own.torque.reshape(*own.torque.shape[:3], n, samples)
                known = out.get(name, ([], []))
                out[name] = [*known[0], filter_rows(self.records, torque, fitted=True)], [*known[1], own.joints]
        return self.unturned | {name: (np.concatenate(rows), np.concatenate(at)) for name, (rows, at) in out.items()}

    @cached_property
    def unturned(self) -> dict[str, tuple[Float[np.ndarray, "e k r n M"], Int[np.ndarray, "e r"]]]:
        """Of `plain`, what effects with a shape keep from a problem with another width of the friction's reversal."""
        return {}

    def _family(self, name: str) -> dict[str, Units]:
        """Unit torques of a family of the measured motion, on one axis of places and grid points."""
        return units({n: flattened(b) for n, b in self.families[name].items()}, self.motion, self.records)

    def shaped_in_parts(self, wanted: Mapping[str, Bool[np.ndarray, " effects"]]) -> Iterator[dict[str, Units]]:
        """Unit torques of effects with a shape: all at once, of long recordings a few of one effect at a time.

        The torque of all grid points at all samples would be the largest thing in memory by far. `wanted` are the ones
        asked for, on one axis of places and grid points.
        """
        if wanted and len(self.motion.time) <= SHORT:
            every = self._family("shaped")
            yield {name: every[name].of(own) for name, own in wanted.items()}
            return
        for name in wanted:
            whole = flattened(self.families["shaped"][name])
            for part in (slice(start, start + AT_ONCE) for start in range(0, len(whole.at), AT_ONCE)):
                if wanted[name][part].any():
                    few = jax.tree.map(lambda x, part=part: np.asarray(x)[part], whole)
                    yield {name: units({name: few}, self.motion, self.records)[name].of(wanted[name][part])}

    def following(self, effect: str, motion: Motion) -> Units:
        """Unit torques of one effect that follows the torque of the current model.

        Each has a program of its own: it serves one of them as well.
        """
        return units({effect: flattened(self.families["following"][effect])}, motion, self.records)[effect]

    @cached_property
    def _terms(self) -> OrderedDict[Any, tuple[Motion, Any]]:
        return OrderedDict()

    def kept(self, name: Any, motion: Motion, make: Callable[[], T]) -> T:
        """What has been made under the name of the same motion, or is made now; the last few are held."""
        known = self._terms.pop(name, None)
        made = known[1] if known is not None and known[0] is motion else make()
        self._terms[name] = motion, made
        while len(self._terms) > MOST_TERMS:
            self._terms.popitem(last=False)
        return made

    def within_trust(self) -> Problem:
        """The problem with links that stay within what is believed of them, where that is much."""
        if self.trust > TRUSTED:
            return self
        other = replace(self, bounded=True)
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k not in other.__dict__})
        return other

    def with_width(self, width: Float[np.ndarray, " nv"]) -> Problem:
        """The problem with another width of the friction's reversal, which no candidate's place and grid depends on."""
        other = replace(self, width=width)
        same = ("torque", "read", "reached", "gain", "families", "unturned")
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k in same})
        if "plain" in self.__dict__:
            shaped = self.families["shaped"].items()
            other.__dict__["unturned"] = {n: self.plain[n] for n, batch in shaped if not batch.reverses}
        return other


def family_of(effect: type[Effect]) -> str:
    """How an effect is screened: `link`, `sensor`, `following` (the torque), `shaped` (a grid) or `fixed` columns."""
    if effect.inertial:
        return "link"
    if kind(effect) != "columns" or not (effect.has("torque") or effect.has("torque_error")):
        return "sensor"
    if effect.follows_torque:
        return "following"
    return "shaped" if shapes(effect) else "fixed"
