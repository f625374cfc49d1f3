"""Lines of `driveby watch` into a pipe on what has become silent, and on the connection."""

from typing import Final, NamedTuple

from services.cli.realm_model import RealmModel, ServiceRow
from services.cli.watch_page import ListenerView, silent_services, silent_trucks


class Absentees(NamedTuple):
    """Trucks and services that are silent."""

    trucks: frozenset[str]
    services: dict[str, ServiceRow]
    """Silent services with their last health."""
    is_lost: bool
    """Whether the connection to the router is lost."""


NOTHING_ABSENT: Final = Absentees(frozenset(), {}, is_lost=False)


def presence_lines(
    before: Absentees,
    model: RealmModel,
    listening: ListenerView,
    now_s: float,
    now_ns: int,
) -> tuple[Absentees, list[str]]:
    """Return what is silent now, and a line for each change.

    While the connection is lost nothing is known of trucks and services: they are as before.
    """
    if listening.lost_s is not None:
        lines = [] if before.is_lost else ["connection to the router lost"]
        return before._replace(is_lost=True), lines
    lines = ["connected again"] if before.is_lost else []
    trucks = silent_trucks(model, now_s)
    names = silent_services(model, listening, now_s, now_ns)
    services = {name: model.services[name] for name in names}
    lines += [f"{name} is silent" for name in sorted(trucks - before.trucks)]
    lines += [f"{name} is silent" for name in sorted(names - before.services.keys())]
    # With a new health it has its own line already.
    back = [name for name, row in before.services.items() if model.services.get(name) is row]
    lines += [f"{name} is back" for name in sorted(back) if name not in names]
    return Absentees(trucks, services, is_lost=False), lines
