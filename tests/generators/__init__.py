"""Recordings with known causes hidden in them, made without any code of the library.

Pinocchio (`inverse`) and MuJoCo C (`closed_loop`) are the only physics here, so a law that the library has wrong is
not wrong in the same way on both sides. `make_case` hides effects of given size, `Case.write` leaves a task on disk.
"""

from .case import Case, Truth
from .closed_loop import CLOSED_LOOP_EFFECTS, make_closed_loop_case
from .inverse import CLASSES, DIFFERS, EFFECTS, FOREIGN, make_case, observable
from .robots import available

__all__ = [
    "CLASSES",
    "CLOSED_LOOP_EFFECTS",
    "DIFFERS",
    "EFFECTS",
    "FOREIGN",
    "Case",
    "Truth",
    "available",
    "make_case",
    "make_closed_loop_case",
    "observable",
]
