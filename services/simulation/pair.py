"""The vehicle and the bridge of a site file that are simulated."""

from collections.abc import Sequence

from schemas.site import Site
from services.common.errors import InputError

_SHOWN = 20
"""Largest number of identifiers in an error."""


def with_pair_first(site: Site, vehicle: str | None, bridge: str | None) -> Site:
    """Return the site with this vehicle and this bridge first, the pair that simulations take.

    None keeps the order. Raise InputError for an identifier that the site does not have.
    """
    first = _place("--vehicle", [one.id for one in site.vehicles], vehicle)
    vehicles = (site.vehicles[first], *site.vehicles[:first], *site.vehicles[first + 1 :])
    first = _place("--bridge", [one.id for one in site.bridges], bridge)
    bridges = (site.bridges[first], *site.bridges[:first], *site.bridges[first + 1 :])
    return site.model_copy(update={"vehicles": vehicles, "bridges": bridges})


def _place(option: str, known: Sequence[str], wanted: str | None) -> int:
    """Return the index of the wanted identifier, 0 for None; raise InputError if it is unknown."""
    if wanted is None:
        return 0
    if wanted not in known:
        raise InputError(f"{option}: the site has no {wanted}, it has {', '.join(known[:_SHOWN])}")
    return known.index(wanted)
