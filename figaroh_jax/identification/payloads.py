"""Payloads: an unknown one as ten parameters on a frame, a known one as the measure of the drives' gains.

Recordings with and without the payload share the robot's parameters. Where the payload is known, its torque is the one
that no gain can change, so it tells the gains of all drives at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..effects.base import Effect
from ..errors import InputError
from ..estimation.base_parameters import TEN, BaseParameters, base_parameters
from ..estimation.regression import Piece
from ..estimation.states import States
from ..recordings.dataset import carried_body
from ..rigid.inertia import transform
from ..rigid.model import RobotModel

if TYPE_CHECKING:
    from ..formats.config import Load

__all__ = ["DriveGains", "PayloadStates", "drive_gains"]

CLEAR = 0.3  # of the next singular value: a larger smallest one leaves the gains to chance


@dataclass(frozen=True)
class PayloadStates:
    """Rows for `regression.condense` of states without (`bare`) and with (`loaded`) an unknown body on a frame.

    The columns of `States`, then ten for the body, at and in the frame: `m_<frame>` to `Izz_<frame>`.
    """

    bare: States
    loaded: States
    frame: str

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return (*self.bare.names, *(f"{name}_{self.frame}" for name in TEN))

    @cached_property
    def structure(self) -> Float[np.ndarray, "samples nv columns"]:
        """Columns at random states, without and with the body."""
        plain = self.bare.structure
        return np.concatenate([self._beside(plain, False), self._beside(plain, True)])

    @property
    def used(self) -> Bool[np.ndarray, "nv columns"]:
        """Which columns of a joint's rows can differ from zero."""
        return np.asarray(np.abs(self.structure).max(axis=0) > 0)

    @property
    def structural(self) -> BaseParameters:
        """Base parameters that some motion could show."""
        return base_parameters(self.structure.reshape(-1, len(self.names)), self.names)

    def pieces(self, widths: Sequence[float] = (), fitted: bool = True) -> Iterator[Piece]:
        """Pieces of the bare states, then of the loaded ones."""
        if widths:
            raise InputError("PayloadStates takes no widths of reversals")
        for states, carries in ((self.bare, False), (self.loaded, True)):
            for piece in states.pieces(fitted=fitted):
                yield piece._replace(X=self._beside(piece.X, carries), recording=int(carries))

    def _beside(self, X: np.ndarray, carries: bool) -> np.ndarray:
        model = self.bare.model
        index = model.frame_index(self.frame)
        link = model.frames[index].parent
        if link < 0:
            raise InputError(f"frame '{self.frame}' does not move: no torque shows what it carries")
        with jax.enable_x64(True):
            moved = [np.asarray(transform(ten, np.asarray(model.frame_placement[index]))) for ten in np.eye(10)]
        own = X[:, :, 10 * link : 10 * link + 10] @ np.stack(moved, axis=1)
        return np.concatenate([X, own if carries else np.zeros_like(own)], axis=2)


class DriveGains(NamedTuple):
    """Gains of the drives, with the robot's base parameters in the units that they give."""

    gains: Float[np.ndarray, " nv"]  # torque (N m or N) for a unit of the reading
    parameters: Float[np.ndarray, " columns"]  # of the independent columns; zero elsewhere
    clearness: float  # smallest singular value over the next: far below one where the payload tells the gains


def drive_gains(
    model: RobotModel,
    terms: tuple[Effect, ...],
    base: BaseParameters,
    recordings: Iterable[tuple[Any, Any, Any, Any, Load | None]],
    noise: Float[np.ndarray, " nv"] | None = None,
) -> DriveGains:
    r"""Gains from readings u of the motors (currents) in recordings without and with a known payload.

    In every row $u_j g_j = W \theta + W_L \theta_L$, the last term known. The readings carry the errors (`noise`: one
    sigma of each joint's, by default its RMS), the other columns none: total least squares on what is left of the
    readings beside those, scaled by the payload's column (Gautier and Briot, 2014). `recordings` are
    (q, v, a, u, load), load None without a payload. Raises `InputError` where no payload was carried, or the gains
    stay undetermined. An example: `examples/payload_and_gains.py`.
    """
    rank, nv = base.rank, model.nv
    factor, square, loaded = np.zeros((0, rank + 1 + nv)), np.zeros(nv), False
    for q, v, a, u, load in recordings:
        link, ten = (0, np.zeros(10)) if load is None else carried_body(model, load)
        loaded |= load is not None
        for piece in States(model, lambda part=(q, v, a, u): [part], terms).pieces():
            kept = piece.weight[:, 0] > 0
            X, reading = piece.X[kept], piece.y[kept]
            known = X[:, :, 10 * link : 10 * link + 10] @ ten
            columns = [X[:, :, base.independent], known[:, :, None], -reading[:, :, None] * np.eye(nv)]
            rows = np.concatenate(columns, axis=2).reshape(-1, factor.shape[1])
            factor = np.asarray(np.linalg.qr(np.concatenate([factor, rows]), mode="r"))
            square += (reading**2).sum(axis=0)
    if not loaded:
        raise InputError("no recording carries a known payload: without one the gains are free up to a factor")
    sigma = np.sqrt(square) if noise is None else np.asarray(noise, float)
    exact, rest = factor[: rank + 1], factor[rank + 1 :, rank + 1 :] / np.where(sigma > 0, sigma, 1.0)
    _, values, ways = np.linalg.svd(rest)
    gains = ways[-1] / np.where(sigma > 0, sigma, 1.0)
    length = np.linalg.norm(exact[:, : rank + 1], axis=0)
    others = -np.linalg.lstsq(exact[:, : rank + 1] / length, exact[:, rank + 1 :] @ gains, rcond=None)[0] / length
    clearness = float(values[-1] / values[-2]) if nv > 1 else 0.0
    if clearness > CLEAR or abs(others[-1]) < 1e-9 * np.abs(others).max():
        raise InputError(
            f"the payload does not determine the gains: smallest singular value {clearness:.2g} of the next; move the"
            " joints more, or carry a heavier payload"
        )
    theta = np.zeros(len(base.names))
    theta[base.independent] = others[:-1] / others[-1]
    return DriveGains(gains / others[-1], theta, clearness)
