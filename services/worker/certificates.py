"""Certificates of the pairs that have crossings waiting: made aside, kept in a folder, looked for.

One pair at a time, those that drive most and latest first; crossings that need not wait come
before (`Processes`). Which crossings wait is the engine's to know.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from schemas.certificates import (
    Certificate,
    Pair,
    Tried,
    certificate_path,
    load_certificate,
    pair_hash,
)
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.common.errors import InputError
from services.execution.processes import Aside, Processes
from services.history.certificates import save
from services.simulation.certificate import Trial

_log = logging.getLogger(__name__)
LOOK_AGAIN_S: Final = 10.0
"""So often it is looked whether a certificate has come that lets waiting crossings go on."""


class Certificates:
    """Takes pairs that are wanted; tells which have a certificate that passed, as they have one."""

    def __init__(
        self,
        folder: Path,
        site: Site,
        settings: IdentificationSettings,
        processes: Processes,
        *,
        look_again_s: float = LOOK_AGAIN_S,
    ) -> None:
        self._folder = folder
        self._site = site
        self._settings = settings
        self._processes = processes
        self._look_again_s = look_again_s
        self._wanted: deque[Pair] = deque()
        self._trial: Trial | None = None
        self._numbers: dict[str, int] = {}
        """Of the crossings that are under way, by the names of their asides."""
        self._failed: dict[Pair, str] = {}
        """Why, in one sentence."""
        self._next_look_s = 0.0
        self.has_news = False
        """Whether `note` has changed since it was looked at; whoever looks resets it."""

    def want(self, pair: Pair) -> None:
        """Take note that crossings of a pair wait."""
        self._wanted.append(pair)
        self._next_look_s = 0.0

    def advance(self, now_s: float, order: Callable[[], Sequence[Pair]] = tuple) -> dict[Pair, str]:
        """Go on, by any steady clock; return the hashes of what has come to pass since.

        `order` says which pairs are to be next, where several wait; others come after them, in the
        order in which they were asked for.
        InputError, FailureError: a certificate cannot be written.
        """
        passed = self._looked_for() if now_s >= self._next_look_s else {}
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + self._look_again_s
        if self._trial is None and self._wanted:
            pair = next((p for p in order() if p in self._wanted), self._wanted[0])
            self._wanted.remove(pair)
            self._trial = Trial(self._site, pair, self._settings)
            self._numbers.clear()
            self.has_news = True
            _log.info("%s has no certificate yet: its simulated crossings begin", pair)
        if self._trial is not None:
            self._go_on(self._trial)
            if self._trial.judgement is not None:
                passed |= self._ended(self._trial.certificate(time.time()))
                self._trial = None
        return passed

    def retarget(self, site: Site) -> None:
        """From now on make those of another site file; what was wanted is to be asked for again."""
        self._processes.forget_asides()
        self._site = site
        self._trial = None
        self._numbers.clear()
        self._wanted.clear()
        self._failed.clear()
        self.has_news = True

    def end(self) -> None:
        """Begin no more crossings: a trial that is not over begins anew in the next run."""
        self._processes.forget_asides()

    @property
    def progress(self) -> tuple[Pair, float] | None:
        """Which pair's crossings are simulated, and how much of them is done."""
        return None if self._trial is None else (self._trial.pair, self._trial.share)

    @property
    def note(self) -> str:
        """What keeps crossings waiting, in one line; empty if nothing does."""
        parts = [f"{pair} is not validated: {reason}" for pair, reason in self._failed.items()]
        if self._trial is not None:
            parts.append(f"{self._trial.pair} is being validated")
        if self._wanted:
            parts.append(f"{len(self._wanted)} more wait for it")
        return "; ".join(parts)

    def _go_on(self, trial: Trial) -> None:
        for aftermath in self._processes.aftermaths():
            number = self._numbers.pop(aftermath.aside.name, None)
            if number is None:
                continue  # of a pair whose trial is over
            if isinstance(aftermath.outcome, Tried):
                trial.add(number, aftermath.outcome)
            else:
                trial.give_up(number)
        while trial.judgement is None and self._processes.wants_aside:
            one = trial.next_run()
            if one is None:
                return
            digest = pair_hash(self._site, trial.pair, self._settings)  # of this site file
            name = f"simulated crossing {one.number} of {trial.pair} ({digest})"
            self._numbers[name] = one.number
            self._processes.start_aside(Aside(name, one.run))

    def _ended(self, certificate: Certificate) -> dict[Pair, str]:
        self._processes.forget_asides()
        path = save(self._folder, certificate)
        if certificate.passed:
            _log.info("%s is validated: %s (%s)", certificate.pair, certificate.reason, path)
            self.has_news = True
            return {certificate.pair: certificate.hash}
        self._fails(certificate)
        return {}

    def _looked_for(self) -> dict[Pair, str]:
        """What has come into the folder, or was there already."""
        passed = {}
        for pair in [*self._failed, *self._wanted]:
            path = certificate_path(self._folder, pair_hash(self._site, pair, self._settings))
            if not path.exists():
                continue
            try:
                certificate = load_certificate(path)
            except InputError as error:
                _log.warning("%s; it is made anew", error)
                continue
            if certificate.passed:
                passed[pair] = certificate.hash
                self._failed.pop(pair, None)
                self.has_news = True
                _log.info("%s is validated: %s (%s)", pair, certificate.reason, path)
            else:
                self._fails(certificate)
            if pair in self._wanted:
                self._wanted.remove(pair)
        return passed

    def _fails(self, certificate: Certificate) -> None:
        pair = certificate.pair
        if self._failed.get(pair) == certificate.reason:
            return
        self._failed[pair] = certificate.reason
        self.has_news = True
        _log.error(
            "%s is not validated, its crossings wait: %s (%s)",
            pair,
            certificate.reason,
            certificate_path(self._folder, certificate.hash),
        )
