"""Files of alarms in a history: reading and acknowledging.

An alarm is a file `alarms/realm=R/bridge=B/ID.json` that is written once; its acknowledgement is
`ID.ack.json` next to it. Nothing removes either: an alarm is active until it is acknowledged,
whatever later crossings show, and over any restart. An alarm's id is a hash of its content, so two
programs that raise it write one file.
"""

from pathlib import Path
from typing import Final

from pydantic import ValidationError

from schemas.alarms import Acknowledgement, Alarm
from schemas.json_file import load_json
from services.common.errors import InputError, one_line
from services.common.files import write_atomically

ALARMS: Final = "alarms"
_ACKNOWLEDGED: Final = ".ack.json"


def alarms_of(folder: Path, realm: str, bridge: str) -> tuple[list[Alarm], list[str]]:
    """Return all alarms of a bridge in order of time, and the invalid files, one line each."""
    where = alarms_folder(folder, realm, bridge)
    found, problems = [], []
    for path in sorted(where.glob("*.json")):
        if path.name.endswith(_ACKNOWLEDGED):
            continue
        try:
            alarm = _load(path, realm, bridge)
            noted = path.with_name(f"{alarm.alarm_id}{_ACKNOWLEDGED}")
            if noted.exists():
                try:
                    note = load_json(Acknowledgement, noted, "an acknowledgement")
                    alarm = alarm.model_copy(update={"acknowledged": note})
                except InputError as error:  # the alarm then stays active
                    problems.append(str(error))
            found.append(alarm)
        except InputError as error:
            problems.append(str(error))
    return sorted(found, key=lambda alarm: (alarm.raised, alarm.alarm_id)), problems


def _load(path: Path, realm: str, bridge: str) -> Alarm:
    """Return the alarm of a file; InputError if it is not one, or not that of its name."""
    alarm = load_json(Alarm, path, "an alarm")
    if (alarm.realm, alarm.bridge, alarm.alarm_id) != (realm, bridge, path.stem):
        raise InputError(
            f"{path}: is alarm {alarm.alarm_id} of {alarm.bridge} in realm {alarm.realm}, "
            "which does not belong here"
        )
    return alarm


def bridges_with_alarms(folder: Path) -> list[tuple[str, str]]:
    """Return realm and name of all bridges that have files of alarms."""
    return [
        (path.parent.name.removeprefix("realm="), path.name.removeprefix("bridge="))
        for path in sorted((folder / ALARMS).glob("realm=*/bridge=*"))
    ]


def active_alarms(folder: Path) -> tuple[list[Alarm], list[str]]:
    """Return the alarms of a history without an acknowledgement, and the invalid files."""
    found, problems = [], []
    for realm, bridge in bridges_with_alarms(folder):
        alarms, wrong = alarms_of(folder, realm, bridge)
        found += [alarm for alarm in alarms if alarm.acknowledged is None]
        problems += wrong
    return found, problems


def acknowledged_since(folder: Path, time_s: float) -> list[Alarm]:
    """Return the last alarm of each bridge, if it was acknowledged since a time."""
    last = [alarms_of(folder, *name)[0][-1:] for name in bridges_with_alarms(folder)]
    return [
        alarm
        for some in last
        for alarm in some
        if alarm.acknowledged is not None and alarm.acknowledged.time >= time_s
    ]


def acknowledge(folder: Path, alarm: Alarm, by: str, note: str, time_s: float) -> Alarm:
    """Write the acknowledgement of an alarm; the first one counts.

    Raise InputError if it is acknowledged already, if a damaged file is in the place of its
    acknowledgement, or if a text is too long.
    """
    where = alarms_folder(folder, alarm.realm, alarm.bridge)
    path = where / f"{alarm.alarm_id}{_ACKNOWLEDGED}"
    if path.exists():
        try:
            load_json(Acknowledgement, path, "an acknowledgement")
        except InputError as error:
            raise InputError(f"{error}; move that file away and acknowledge again") from None
    if alarm.acknowledged is not None or path.exists():
        raise InputError(f"{path}: {alarm.bridge} {alarm.alarm_id} is acknowledged already")
    try:
        acknowledgement = Acknowledgement(by=one_line(by), time=time_s, note=one_line(note))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        raise InputError(f"--{problem['loc'][0]}: {problem['msg']}") from None
    write_atomically(path, acknowledgement.model_dump_json(indent=1) + "\n")
    return alarm.model_copy(update={"acknowledged": acknowledgement})


def alarms_folder(folder: Path, realm: str, bridge: str) -> Path:
    """Return the folder of a bridge's alarms."""
    return folder / ALARMS / f"realm={realm}" / f"bridge={bridge}"
