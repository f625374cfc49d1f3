"""Choice of a truck that resolves the elements of a bridge better than a given one."""

from schemas.site import Vehicle


def truck_to_try(vehicle: Vehicle) -> str:
    """Return the key of the sentence part that names a better truck: `unlike`, `single`, `tandem`.

    The key is the kind of `vehicle`: equal single tyres are better than unlike ones, an equalised
    tandem is better than both.
    """
    if vehicle.tandem is not None:
        return "tandem"
    return "single" if vehicle.has_equal_single_tyres else "unlike"
