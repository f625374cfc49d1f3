"""`driveby validate --site`: certificates of the pairs of a site file."""

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.certificates import Certificate, Pair, certificate_path, pair_hash
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import load_site
from services.common.errors import InputError
from services.common.files import check_writable, make_folder
from services.common.progress import progress_bar
from services.history.certificates import save
from services.simulation.certificate import CROSSINGS, Trial, tried_in_processes

if TYPE_CHECKING:
    from rich.console import Console


def validate_site_command(
    *,
    site: Path,
    truck: str | None,
    bridge: str | None,
    certificates: Path,
    seed: int,
    processes: int,
    console: "Console",
) -> int:
    """Make the certificate of every pair of the site, print a line for each; 1 if one failed.

    InputError: a bad site file, a vehicle or bridge that it has not, a folder where nothing can be
    written.
    """
    known = load_site(site)
    pairs = _pairs(known, site, truck, bridge)
    settings = IdentificationSettings()
    make_folder(certificates)
    for pair in pairs:
        check_writable(certificate_path(certificates, pair_hash(known, pair, settings)))
    have_passed = True
    # Not by fork: numba's and OpenBLAS's threads would not survive it.
    with (
        progress_bar(console) as bar,
        ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool,
    ):
        task = bar.add_task("simulated crossings", total=len(pairs))
        for done, pair in enumerate(pairs):
            trial = Trial(known, pair, settings, seed)
            for share in tried_in_processes(trial, pool, processes):
                bar.update(task, completed=done + share)
            certificate = trial.certificate(time.time())
            path = save(certificates, certificate)
            have_passed &= certificate.passed
            console.print(line_of(certificate, path), highlight=False, soft_wrap=True)
    return 0 if have_passed else 1


def _pairs(known: Site, path: Path, truck: str | None, bridge: str | None) -> list[Pair]:
    """The pairs that are asked for; InputError if the site has no such vehicle or bridge."""
    vehicles, bridges = [v.id for v in known.vehicles], [b.id for b in known.bridges]
    for option, wanted, ids in (("--truck", truck, vehicles), ("--bridge", bridge, bridges)):
        if wanted is not None and wanted not in ids:
            raise InputError(f"{option}: {path} has no {wanted}, it has {', '.join(ids[:20])}")
    return [
        Pair(v, b) for v in vehicles if truck in (None, v) for b in bridges if bridge in (None, b)
    ]


def line_of(certificate: Certificate, path: Path) -> str:
    """What a certificate says, in one line."""
    figures = certificate.figures
    how = "passed" if certificate.passed else "FAILED"
    fewer = "" if figures.crossings == CROSSINGS else f" (of {CROSSINGS}, the rest not needed)"
    std = "" if figures.std is None else f"; EI ± {100.0 * figures.std:.0f} %"
    return f"{certificate.pair}: {how}{fewer}: {certificate.reason}{std}; {path}"
