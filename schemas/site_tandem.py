"""Tandems of a site file: the axles of `[[vehicle.axles]]` that are compared.

Two axles that share one spring force follow nearly the same road, and their forces are known
without the springs' parameters. If each axle of a tandem has its own spring, the difference of
their forces follows from the springs' law, and friction of a few per cent of the load hides the
difference of the deflections.

All axles ahead of the tandem have springs of their own. The sum of their forces follows from heave
and pitch of the body, as if it acted at one place; each axle has a known share of it.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from schemas.site_axle_tables import MECHANICAL, Axle, Bogie
from schemas.site_errors import error_at

LEAST_AXLES: Final = 3
_LARGEST_UNEVENNESS: Final = 0.8
"""Largest share of one axle; beyond it the other one carries too little to be compared."""


class FrontAxle(NamedTuple):
    """An axle ahead of the tandem, and its share of the static spring force of all of these."""

    axle: Axle
    share: float


class Tandem(NamedTuple):
    """The two last axles of a truck, which are compared, and those ahead of them."""

    front_axles: tuple[FrontAxle, ...]
    """Axles ahead of the tandem, from front to rear."""
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
    def number(self) -> int:
        """Number of the first of the compared axles, from 1 at the front of the truck."""
        return len(self.front_axles) + 1

    @property
    def gap_m(self) -> float:
        """Distance between the compared axles."""
        return self.second.position_m - self.first.position_m

    @property
    def front(self) -> Axle:
        """The front axle; several are one at their common force, with the sums of their values."""
        axles, shares = zip(*self.front_axles, strict=True)
        return _joined(axles, shares)

    @property
    def rear(self) -> Axle:
        """The axle in place of both compared ones: at their spring force, with sums of values."""
        return _joined(self.axles, (self.share, 1.0 - self.share))


def tandem_of(axles: Sequence[Axle], bogies: Sequence[Bogie]) -> Tandem:
    """Return the tandem of a truck with more than two axles; raise a FieldError without one."""
    if len(axles) < LEAST_AXLES:
        raise error_at("axles", f"has {len(axles)} axles, a tandem must have one ahead of it")
    *ahead, first, second = axles
    number = len(axles) - 1
    bogie = _bogie_of(bogies, number)
    front = _front_axles(ahead)
    if bogie is None or not bogie.equalised:
        if bogie is not None and bogie.shares is not None:
            raise error_at(
                f"bogies.{bogies.index(bogie)}.shares",
                "are of an equalised tandem, remove them or set equalised = true",
            )
        share, spread = _static_share(axles, number)
        return Tandem(front, first, second, share, spread, is_equalised=False)
    of_axle = dict(zip(bogie.axles, bogie.shares or (1.0, 1.0), strict=True))
    share = of_axle[number] / math.fsum(of_axle.values())
    if max(share, 1.0 - share) > _LARGEST_UNEVENNESS:
        raise error_at(
            f"bogies.{bogies.index(bogie)}.shares",
            f"give one axle {100.0 * max(share, 1.0 - share):.0f} % of the force, "
            f"it must be at most {100.0 * _LARGEST_UNEVENNESS:.0f} %",
        )
    return Tandem(front, first, second, share, bogie.share_spread)


def _bogie_of(bogies: Sequence[Bogie], number: int) -> Bogie | None:
    """Return the bogie of the last two axles, the first of which has this number.

    Others may join all axles ahead of these, without load equalisation.
    """
    found = None
    for place, bogie in enumerate(bogies):
        named = sorted(bogie.axles)
        if named == [number, number + 1]:
            if found is not None:
                raise error_at(f"bogies.{place}.axles", "are of a bogie already, remove one")
            found = bogie
        elif named != list(range(1, number)):
            raise error_at(
                f"bogies.{place}.axles",
                f"are {_listed(named)}, they must be the last two axles, {number} and {number + 1}",
            )
        elif bogie.equalised:
            raise error_at(
                f"bogies.{place}.equalised",
                f"is true for axles {_listed(named)}, it must be false: only the last two axles "
                "may share one spring force",
            )
    return found


def _listed(numbers: Sequence[int]) -> str:
    return " and ".join(str(number) for number in numbers)


def _front_axles(ahead: Sequence[Axle]) -> tuple[FrontAxle, ...]:
    """Return the axles ahead of a tandem with their shares; several must have been weighed."""
    if len(ahead) == 1:
        return (FrontAxle(ahead[0], 1.0),)
    carried = [_carried_kg(axle, place, _WEIGHED_AHEAD) for place, axle in enumerate(ahead)]
    whole = math.fsum(carried)
    return tuple(FrontAxle(axle, one / whole) for axle, one in zip(ahead, carried, strict=True))


_WEIGHED: Final = "the axles of a tandem without load equalisation are weighed"
_WEIGHED_AHEAD: Final = "two or more axles ahead of a tandem are weighed"


def _carried_kg(axle: Axle, place: int, why: str) -> float:
    """Return the load on the springs of an axle, the truck's at `place` from 0, if it is known."""
    if axle.load_kg is None:
        raise error_at(f"axles.{place}.load_kg", f"is missing, it must be a mass in kg: {why}")
    carried = axle.load_kg - axle.unsprung_mass_kg
    if carried <= 0.0:
        raise error_at(
            f"axles.{place}.unsprung_mass_kg",
            f"is {axle.unsprung_mass_kg:g}, it must be a mass less than the load of the axle",
        )
    return carried


def _static_share(axles: Sequence[Axle], number: int) -> tuple[float, float]:
    """Return the share of the load on the springs of axle `number`, of both, and its spread."""
    pair = axles[number - 1 :]
    carried = [_carried_kg(axle, number - 1 + w, _WEIGHED) for w, axle in enumerate(pair)]
    share = carried[0] / math.fsum(carried)
    if max(share, 1.0 - share) > _LARGEST_UNEVENNESS:
        raise error_at(
            f"axles.{number - 1}.load_kg",
            f"and the load of axle {number + 1} give one axle "
            f"{100.0 * max(share, 1.0 - share):.0f} % of the load of both, it must be at most "
            f"{100.0 * _LARGEST_UNEVENNESS:.0f} %",
        )
    errors = [
        (axle.load_kg or 0.0) * axle.load_kg_spread / one
        for axle, one in zip(pair, carried, strict=True)
    ]
    return share, (1.0 - share) * math.hypot(*errors)


def _joined(axles: Sequence[Axle], shares: Sequence[float]) -> Axle:
    """Return one axle in place of several that share one force; a single one is unchanged."""
    if len(axles) == 1:
        return axles[0]
    together: dict[str, float | None] = {
        key: math.fsum(getattr(axle, key) for axle in axles) for key in MECHANICAL
    }
    loads = [axle.load_kg for axle in axles if axle.load_kg is not None]
    together["load_kg"] = None
    if len(loads) == len(axles):
        together["load_kg"] = math.fsum(loads)
        errors = [(axle.load_kg or 0.0) * axle.load_kg_spread for axle in axles]
        together["load_kg_spread"] = math.hypot(*errors) / math.fsum(loads)
    together["position_m"] = math.fsum(
        share * axle.position_m for share, axle in zip(shares, axles, strict=True)
    )
    return axles[0].model_copy(update=together)
