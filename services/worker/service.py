"""Parts of a running worker, and what it publishes: results, progress and health.

A message is on the disk before it is on the bus, so the results files have everything that was
published. A new run reads them: it republishes unchanged what the bus may have missed, publishes
the pending messages, and identifies no crossing that has a result.
"""

import logging
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from schemas.proto import driveby_pb2 as pb
from schemas.results import VERDICTS, ResultHeader
from schemas.settings import IdentificationSettings
from schemas.signals import Identity
from schemas.site import Site
from schemas.topics import Message
from services.bus.publisher import Publisher
from services.common.errors import FailureError
from services.common.naming import count_of
from services.execution.dispatch import CrossingExecutor, dispatch
from services.identification.bridge_state import FusionSettings
from services.identification.engine import Engine
from services.identification.outputs import EngineOutput, Output
from services.ledger.runs import EarlierRuns, ResultFiles
from services.worker.health import QueueLag, Workload, log_result, publish_health
from services.worker.site_fit import SiteFit
from services.worker.validation_runner import ValidationRunner

_log = logging.getLogger(__name__)
_MAX_NAMED: Final = 10
"""Maximum number of crossings in one line of the log."""


class Search(NamedTuple):
    """Site file, settings and baselines by which crossings are identified."""

    path: Path
    """The site file."""
    site_toml: str
    site: Site
    settings: IdentificationSettings
    header: ResultHeader
    fusing: FusionSettings
    certificates: Path
    """Folder of validation records."""


@dataclass(frozen=True)
class WorkerService:
    """Parts of a run: engine, executor, and destinations of their outputs."""

    id: str
    engine: Engine
    execution: CrossingExecutor
    certificates: ValidationRunner
    publisher: Publisher
    files: ResultFiles
    verdicts: Counter[str] = field(default_factory=lambda: Counter(dict.fromkeys(VERDICTS, 0)))
    """Numbers of this run's results, by verdict."""
    refused: Counter[str] = field(default_factory=Counter)
    """Numbers of invalid messages, by the thread that refused them: each counts on its own."""
    site_fit: SiteFit = field(default_factory=SiteFit)

    def publish(self, outputs: Iterable[Output]) -> None:
        """Write each message to the disk and only then to the bus.

        FailureError: one cannot be written or published.
        """
        for output in _guard_engine(outputs):
            _, owner, identifier, stream = output.key
            identity = self.files.next_identity(output.key, self.publisher.boot_id)
            now_ns = time.time_ns()
            message = Message(output.key, output.payload, *identity, now_ns, now_ns)
            self.files.write(message, output.result, self.engine.bridges())
            try:
                self.publisher.put(owner, identifier, stream, output.payload, identity)
            except ValueError as error:
                raise FailureError(
                    f"{stream} of {identifier} cannot be published: {error}"
                ) from error
            if output.result is not None:
                self.verdicts[output.result.verdict] += 1
                log_result(output.result)

    def process_outputs(self, outputs: Iterable[EngineOutput]) -> None:
        """Publish the engine's messages, and execute its tasks."""
        self.publish(dispatch(self.engine, self.execution, outputs, self.certificates.request))

    def publish_health(self, behind: QueueLag, load: Workload) -> None:
        """Publish `health`."""
        put = partial(self.publisher.put, "service", self.id, "health")
        publish_health(
            put, self.id, self.execution, behind, load,
            verdicts=self.verdicts,
            note="; ".join(filter(None, (self.certificates.note, self.site_fit.complaint()))),
        )  # fmt: skip

    def publish_end(self) -> None:
        """Publish as the last `health` that the worker ends in order."""
        health = pb.Health(
            schema_version=1, time_ns=time.time_ns(), service=self.id, ok=True, ended=True
        )
        self.publisher.put("service", self.id, "health", health.SerializeToString())

    def resume(self, earlier: EarlierRuns) -> None:
        """Resume earlier runs: republish what may not have been received, and finish the rest.

        Pending states of bridges are published once they are computed, while the worker listens.
        """
        again = [
            *earlier.unconfirmed,
            *(m for m in earlier.latched if m not in earlier.unconfirmed),
        ]
        for message in again:
            _, owner, identifier, stream = message.key
            identity = Identity(message.boot_id, message.sequence)
            try:
                self.publisher.put(owner, identifier, stream, message.payload, identity)
            except ValueError as error:
                _log.warning("cannot republish: %s", error)
        finished = list(self.engine.resume(earlier.crossings, earlier.states()))
        self.process_outputs(finished)
        if earlier.previous is not None:
            _log.info(
                "%s of earlier runs, the last in %s; %d republished, %d pending results completed",
                *(count_of(len(earlier.published), "message"), earlier.previous),
                *(len(again), len(finished)),
            )
        waited = [
            known.crossing_id
            for known in earlier.crossings
            if pb.WAITING_NOT_VALIDATED in known.states and not known.is_identified
        ]
        if waited:
            _log.warning(
                "%s waited for a site validation when an earlier run ended (%s); identified later "
                "if their trucks or the logger's recordings still have them",
                *(count_of(len(waited), "crossing"), named(waited)),
            )


def _guard_engine(outputs: Iterable[Output]) -> Iterator[Output]:
    """Yield the engine's messages; blame an error within it on no message."""
    try:
        yield from outputs
    except ValueError as error:
        _log.error("the engine failed; ending this worker", exc_info=True)
        raise FailureError(f"a crossing could not be processed: {error}") from error


def named(crossings: list[str]) -> str:
    """Return the last crossings' names for a line of the log."""
    return ", ".join(crossings[-_MAX_NAMED:])


def publish_progress(
    publisher: Publisher, service_id: str, crossing_id: str, stage: str, fraction: float
) -> None:
    """Publish how far an identification or a validation is."""
    progress = pb.Progress(
        schema_version=1,
        time_ns=time.time_ns(),
        crossing_id=crossing_id,
        stage=stage,
        fraction=fraction,
    )
    publisher.put("service", service_id, "progress", progress.SerializeToString())
