"""Words on a road class that a simulation or forecast assumes."""


def assumed_road(road_class: str, declared: str | None, key: str) -> str:
    """Return that a road class is assumed, and the option or `key` that sets it.

    Return "" if it is the `declared` class.
    """
    return "" if road_class == declared else f"assumed road class {road_class} ({key})"
