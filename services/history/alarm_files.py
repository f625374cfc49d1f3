"""Alarms of a history as files: read, and acknowledged.

An alarm is a file `alarms/realm=R/bridge=B/ID.json` that is written once; its acknowledgement is
`ID.ack.json` beside it. Nothing removes either: an alarm stands until somebody acknowledges it,
whatever later crossings say, and over any restart. An alarm is called by what it says, so that two
programs that find it write one file.
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
    """All alarms of a bridge in the order of their times; and files that are none, a line each."""
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
                except InputError as error:  # then it stands: nobody knows that it does not
                    problems.append(str(error))
            found.append(alarm)
        except InputError as error:
            problems.append(str(error))
    return sorted(found, key=lambda alarm: (alarm.raised, alarm.alarm_id)), problems


def _load(path: Path, realm: str, bridge: str) -> Alarm:
    """The alarm of a file; InputError if it is none, or another one than the file is called by."""
    alarm = load_json(Alarm, path, "an alarm")
    if (alarm.realm, alarm.bridge, alarm.alarm_id) != (realm, bridge, path.stem):
        raise InputError(
            f"{path}: is alarm {alarm.alarm_id} of {alarm.bridge} in realm {alarm.realm}, "
            "which does not belong here"
        )
    return alarm


def bridges_with_alarms(folder: Path) -> list[tuple[str, str]]:
    """Realm and name of all bridges of which there are files of alarms."""
    return [
        (path.parent.name.removeprefix("realm="), path.name.removeprefix("bridge="))
        for path in sorted((folder / ALARMS).glob("realm=*/bridge=*"))
    ]


def standing(folder: Path) -> tuple[list[Alarm], list[str]]:
    """All alarms of a history that nobody has acknowledged, and files that are none."""
    found, problems = [], []
    for realm, bridge in bridges_with_alarms(folder):
        alarms, wrong = alarms_of(folder, realm, bridge)
        found += [alarm for alarm in alarms if alarm.acknowledged is None]
        problems += wrong
    return found, problems


def acknowledged_since(folder: Path, time_s: float) -> list[Alarm]:
    """The last alarm of each bridge, if somebody has taken note of it since then."""
    last = [alarms_of(folder, *whose)[0][-1:] for whose in bridges_with_alarms(folder)]
    return [
        alarm
        for some in last
        for alarm in some
        if alarm.acknowledged is not None and alarm.acknowledged.time >= time_s
    ]


def acknowledge(folder: Path, alarm: Alarm, by: str, note: str, time_s: float) -> Alarm:
    """Write down that somebody has taken note of an alarm; the first who does so counts.

    InputError if it is acknowledged already, a file that is damaged stands where its
    acknowledgement would, or what is said is too long.
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
        said = Acknowledgement(by=one_line(by), time=time_s, note=one_line(note))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        raise InputError(f"--{problem['loc'][0]}: {problem['msg']}") from None
    write_atomically(path, said.model_dump_json(indent=1) + "\n")
    return alarm.model_copy(update={"acknowledged": said})


def alarms_folder(folder: Path, realm: str, bridge: str) -> Path:
    """Where the alarms of a bridge lie."""
    return folder / ALARMS / f"realm={realm}" / f"bridge={bridge}"
