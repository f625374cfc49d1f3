"""Choice of a truck that resolves the elements of a bridge better than a given one."""

from schemas.site import Bridge, Vehicle

TRUCK_CHOICES = ("tandem", "single", "same")
"""Keys of `truck_to_try`, the ones with a better truck first."""


def truck_to_try(vehicle: Vehicle, bridge: Bridge) -> str:
    """Return the key of the sentence part that names a better truck: `tandem`, `single`, `same`.

    A truck with unlike tyres is improved by equal single tyres (`single`), and where a site can be
    simulated with one by an equalised tandem, too (`tandem`). A truck with equal single tyres or
    with a tandem stays the `same`: twelve runs determine an element to about 7 or 10 %
    (studies/surveys.md), so neither improves the other much.
    """
    if vehicle.tandem is not None or vehicle.has_equal_single_tyres:
        return "same"
    return "tandem" if allows_tandem(bridge) else "single"


def allows_tandem(bridge: Bridge) -> bool:
    """Return whether trucks with a tandem can be simulated on a bridge.

    It has one span of equal elements.
    """
    return not bridge.interior_supports_m and len(set(bridge.lengths_m)) == 1
