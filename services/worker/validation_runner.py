"""Site validations of the pairs whose crossings wait: computed in the background, and stored.

One pair at a time is validated, those with the most and latest crossings first; crossings that need
not wait come before (`ProcessExecutor`). The engine holds the waiting crossings.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.validation_records import (
    ValidationCrossing,
    ValidationRecord,
    VehicleBridgePair,
    load_validation,
    pair_hash,
    validation_path,
)
from services.common.errors import InputError
from services.common.log_lines import about
from services.execution.processes import BackgroundTask, ProcessExecutor
from services.history.validation_files import save
from services.simulation.validation_trial import ValidationTrial

_log = logging.getLogger(__name__)
CHECK_EVERY_S: Final = 10.0
"""Interval in s at which the folder is checked for new validation records."""


class ValidationRunner:
    """Runner of requested validations; it returns the pairs with a passed record."""

    def __init__(
        self,
        folder: Path,
        site: Site,
        settings: IdentificationSettings,
        processes: ProcessExecutor,
    ) -> None:
        self._folder = folder
        self._site = site
        self._settings = settings
        self._processes = processes
        self._wanted: deque[VehicleBridgePair] = deque()
        self._trial: ValidationTrial | None = None
        self._numbers: dict[str, int] = {}
        """Numbers of the running crossings, by the names of their tasks."""
        self._failed: dict[VehicleBridgePair, str] = {}
        """Reason of a failed validation, in one sentence."""
        self._next_check_s = 0.0
        self.has_news = False
        """Whether `note` changed since the flag was last reset by its reader."""

    def request(self, pair: VehicleBridgePair) -> None:
        """Request the validation of a pair, whose crossings wait.

        Live crossings and those of recordings request it independently; it is validated once.
        """
        is_running = self._trial is not None and self._trial.pair == pair
        if is_running or pair in self._wanted or pair in self._failed:
            return
        self._wanted.append(pair)
        self._next_check_s = 0.0

    def advance(
        self, now_s: float, order: Callable[[], Sequence[VehicleBridgePair]] = tuple
    ) -> dict[VehicleBridgePair, str]:
        """Advance by any steady clock; return the hashes of newly passed records.

        `order` returns the pairs to validate next, where several wait; others follow in the order
        of their requests.

        Raise InputError or FailureError if a record cannot be written.
        """
        passed = self._scan_folder() if now_s >= self._next_check_s else {}
        if now_s >= self._next_check_s:
            self._next_check_s = now_s + CHECK_EVERY_S
        if self._trial is None and self._wanted:
            pair = next((p for p in order() if p in self._wanted), self._wanted[0])
            self._wanted.remove(pair)
            self._begin(pair)
        if self._trial is not None:
            self._advance_trial(self._trial)
            if self._trial.judgement is not None:
                passed |= self._ended(self._trial.certificate(time.time()))
                self._trial = None
        return passed

    def retarget(self, site: Site) -> None:
        """Continue with another site file; requests must be made again."""
        self._processes.cancel_background()
        self._site = site
        self._trial = None
        self._numbers.clear()
        self._wanted.clear()
        self._failed.clear()
        self.has_news = True

    def end(self) -> None:
        """Start no more crossings: an unfinished validation starts again in the next run."""
        self._processes.cancel_background()

    @property
    def progress(self) -> tuple[VehicleBridgePair, float] | None:
        """Pair that is being validated, and the share of it that is done."""
        return None if self._trial is None else (self._trial.pair, self._trial.share)

    @property
    def note(self) -> str:
        """Reason in one line why crossings wait; empty if none does."""
        parts = [f"{pair} is not validated: {reason}" for pair, reason in self._failed.items()]
        if self._trial is not None:
            parts.append(f"{self._trial.pair} is being validated")
        if self._wanted:
            parts.append(f"{len(self._wanted)} more wait for it")
        return "; ".join(parts)

    def _begin(self, pair: VehicleBridgePair) -> None:
        self._numbers.clear()
        self.has_news = True
        try:
            self._trial = ValidationTrial(self._site, pair, self._settings)
        except InputError as error:
            self._failed[pair] = str(error)
            _log.error(
                "%s cannot be validated, its crossings wait: %s", pair, error, extra=_about(pair)
            )
        else:
            _log.info(
                "%s has no validation record yet: starting its simulated crossings",
                pair,
                extra=_about(pair),
            )

    def _advance_trial(self, trial: ValidationTrial) -> None:
        for finished in self._processes.collect_background():
            number = self._numbers.pop(finished.task.name, None)
            if number is None:
                continue  # it belongs to a finished validation
            if isinstance(finished.outcome, ValidationCrossing):
                trial.add(number, finished.outcome)
            else:
                trial.give_up(number)
        while trial.judgement is None and self._processes.wants_background:
            one = trial.next_run()
            if one is None:
                return
            digest = pair_hash(self._site, trial.pair, self._settings)  # of this site file
            name = f"simulated crossing {one.number} of {trial.pair} ({digest})"
            self._numbers[name] = one.number
            self._processes.submit_background(BackgroundTask(name, one.run))

    def _ended(self, certificate: ValidationRecord) -> dict[VehicleBridgePair, str]:
        self._processes.cancel_background()
        path = save(self._folder, certificate)
        if certificate.passed:
            _log_passed(certificate, path)
            self.has_news = True
            return {certificate.pair: certificate.hash}
        self._record_failure(certificate)
        return {}

    def _scan_folder(self) -> dict[VehicleBridgePair, str]:
        """Return the passed records that are new in the folder, or were there already."""
        passed = {}
        for pair in [*self._failed, *self._wanted]:
            path = validation_path(self._folder, pair_hash(self._site, pair, self._settings))
            if not path.exists():
                continue
            try:
                certificate = load_validation(path)
            except InputError as error:
                _log.warning("%s; validating again", error)
                continue
            if certificate.passed:
                passed[pair] = certificate.hash
                self._failed.pop(pair, None)
                self.has_news = True
                _log_passed(certificate, path)
            else:
                self._record_failure(certificate)
            if pair in self._wanted:
                self._wanted.remove(pair)
        return passed

    def _record_failure(self, certificate: ValidationRecord) -> None:
        pair = certificate.pair
        if self._failed.get(pair) == certificate.reason:
            return
        self._failed[pair] = certificate.reason
        self.has_news = True
        _log.error(
            "%s is not validated, its crossings wait: %s (%s)",
            pair,
            certificate.reason,
            validation_path(self._folder, certificate.hash),
            extra=_about(pair),
        )


def _log_passed(certificate: ValidationRecord, path: Path) -> None:
    pair, reason = certificate.pair, certificate.reason
    _log.info("%s is validated: %s (%s)", pair, reason, path, extra=_about(pair))


def _about(pair: VehicleBridgePair) -> dict[str, str]:
    return about(vehicle=pair.vehicle, bridge=pair.bridge)
