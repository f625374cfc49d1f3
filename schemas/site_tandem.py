"""Tandems of a site file: the axles of `[[vehicle.axles]]` that are compared.

Two axles behind the front axle that share one spring force follow nearly the same road, and their
forces are known without the springs' parameters. If each axle of a tandem has its own spring, the
difference of their forces follows from the springs' law, and friction of a few per cent of the load
hides the difference of the deflections.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from schemas.site_axle_tables import MECHANICAL, Axle, Bogie
from schemas.site_errors import error_at

AXLES: Final = 3
_FIRST: Final = 2
"""Number of the first axle of the tandem."""
_LARGEST_UNEVENNESS: Final = 0.8
"""Largest share of one axle; beyond it the other one carries too little to be compared."""


class Tandem(NamedTuple):
    """A truck's front axle and the two axles behind it."""

    lead: Axle
    first: Axle
    second: Axle
    share: float
    """Share of the first axle in the tandem's spring force; in the static one if not equalised."""
    share_spread: float
    is_equalised: bool = True
    """Whether both axles share one spring force; else each has springs of its own."""

    @property
    def axles(self) -> tuple[Axle, Axle]:
        """The compared axles."""
        return self.first, self.second

    @property
    def gap_m(self) -> float:
        """Distance between the compared axles."""
        return self.second.position_m - self.first.position_m

    @property
    def force_m(self) -> float:
        """Distance of the shared spring force behind the front axle."""
        return self.share * self.first.position_m + (1.0 - self.share) * self.second.position_m


def tandem_of(axles: Sequence[Axle], bogies: Sequence[Bogie]) -> Tandem:
    """Return the tandem of a truck with more than two axles; raise a FieldError without one."""
    if len(axles) != AXLES:
        raise error_at(
            "axles", f"has {len(axles)} axles, it must be two, or a front axle and two behind it"
        )
    if len(bogies) > 1 or (bogies and sorted(bogies[0].axles) != [_FIRST, _FIRST + 1]):
        raise error_at("bogies", "does not join axles 2 and 3, it must be one bogie of these")
    lead, first, second = axles
    if not bogies or not bogies[0].equalised:
        if bogies and bogies[0].shares is not None:
            raise error_at(
                "bogies.0.shares",
                "are of an equalised tandem, remove them or set equalised = true",
            )
        return Tandem(lead, first, second, *_static_share(first, second), is_equalised=False)
    bogie = bogies[0]
    shares = bogie.shares or (1.0, 1.0)
    of_axle = dict(zip(bogie.axles, shares, strict=True))
    share = of_axle[_FIRST] / math.fsum(shares)
    if max(share, 1.0 - share) > _LARGEST_UNEVENNESS:
        raise error_at(
            "bogies.0.shares",
            f"give one axle {100.0 * max(share, 1.0 - share):.0f} % of the force, "
            f"it must be at most {100.0 * _LARGEST_UNEVENNESS:.0f} %",
        )
    return Tandem(lead, first, second, share, bogie.share_spread)


def _static_share(first: Axle, second: Axle) -> tuple[float, float]:
    """Return the share of the load on the springs of the first axle, and its relative spread."""
    carried = []
    for number, axle in ((_FIRST, first), (_FIRST + 1, second)):
        if axle.load_kg is None:
            raise error_at(
                f"axles.{number - 1}.load_kg",
                "is missing, it must be a mass in kg: the axles of a tandem without load "
                "equalisation are weighed",
            )
        carried.append(axle.load_kg - axle.unsprung_mass_kg)
        if carried[-1] <= 0.0:
            raise error_at(
                f"axles.{number - 1}.unsprung_mass_kg",
                f"is {axle.unsprung_mass_kg:g}, it must be a mass less than the load of the axle",
            )
    share = carried[0] / math.fsum(carried)
    if max(share, 1.0 - share) > _LARGEST_UNEVENNESS:
        raise error_at(
            "axles.1.load_kg",
            f"and the load of axle 3 give one axle {100.0 * max(share, 1.0 - share):.0f} % of the "
            f"load of both, it must be at most {100.0 * _LARGEST_UNEVENNESS:.0f} %",
        )
    errors = [
        (axle.load_kg or 0.0) * axle.load_kg_spread / one
        for axle, one in zip((first, second), carried, strict=True)
    ]
    return share, (1.0 - share) * math.hypot(*errors)


def joined(tandem: Tandem) -> Axle:
    """Return the axle in place of both: at their common force, with the sums of their values."""
    first, second = tandem.axles
    together: dict[str, float] = {
        key: getattr(first, key) + getattr(second, key) for key in MECHANICAL
    }
    load: float | None = None
    spread = first.load_kg_spread
    if first.load_kg is not None and second.load_kg is not None:
        load = first.load_kg + second.load_kg
        errors = (first.load_kg * first.load_kg_spread, second.load_kg * second.load_kg_spread)
        spread = math.hypot(*errors) / load
    return first.model_copy(
        update={
            **together,
            "position_m": tandem.force_m,
            "load_kg": load,
            "load_kg_spread": spread,
        }
    )
