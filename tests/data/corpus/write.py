"""What earlier commits wrote: recordings, results, spools, site files, Parquet files.

    python tests/data/corpus/write.py REV

extracts REV, and with its modules writes the folder REV beside this file: the first messages of its
sample recording, a results file with a bridge, a spool, and from the commits on that had them a
history, a folder of results and a catalogue. The environment must have the packages of REV. The
numbers are its own tests' examples. A folder that is there is never written again.
"""

import contextlib
import gzip
import itertools
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
MESSAGES = 16


def first(*names: str) -> Any:
    """Return the first of these modules that the commit has."""
    for name in names:
        with contextlib.suppress(ModuleNotFoundError):
            return import_module(name)
    raise ModuleNotFoundError(names)


def extracted_and_run(revision: str) -> None:
    out = HERE / revision
    out.mkdir()
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", revision], capture_output=True, check=True)
        packed = Path(folder) / "source.tar"
        packed.write_bytes(archive.stdout)
        with tarfile.open(packed) as file:
            file.extractall(folder, filter="data")
        command = [sys.executable, "-P", __file__, "--of", folder, str(out)]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": folder})


def write(source: Path, out: Path) -> None:
    # The installed checkout must not lend the commit what it did not have yet.
    sys.meta_path[:] = [one for one in sys.meta_path if "editable" not in f"{one!r}".lower()]
    sys.path[:] = [one for one in sys.path if Path(one).resolve() != HERE.parents[2]]
    load_site = first("schemas.site_file", "schemas.site").load_site
    shutil.copy(source / "docs" / "site.example.toml", out / "site.toml")
    site = load_site(out / "site.toml")
    reader = first("services.recordings.recording", "services.common.recording")
    writer = first("services.recordings.writer", "services.common.recording")
    sample = source / "recordings" / "sample" / "crossing.mcap"
    start = list(itertools.islice(reader.read_messages(sample), MESSAGES))
    kept = (out / "site.toml").read_text()
    writer.write_recording(out / "drive.mcap", start, site_toml=kept, reason="test")

    spool = first("services.truck.spool", "services.common.spool").Spool(out / "spool")
    for message in start[:4]:
        spool.append(message.key.stream, message.sequence, message.payload)
    spool.sync()
    spool.close()

    results = results_of(site)
    (out / "results.json").write_text(results.model_dump_json(indent=1))
    with contextlib.suppress(ModuleNotFoundError):
        archive = first("services.history.history_store", "services.history.archive")
        archive.add_results(out / "history", results, {results.crossings[0].crossing_id: 9.5})
    with contextlib.suppress(ModuleNotFoundError):
        write_folder(out / "into", results)
    with contextlib.suppress(ModuleNotFoundError):
        catalog = first("services.catalogue.index", "services.history.catalog")
        update = getattr(catalog, "update_catalog", None) or catalog.mend
        stores = import_module("services.common.stores")
        update(stores.folder_at(str(out)))
    for path in (out / "drive.mcap", out / "results.json"):
        path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes(), mtime=0))
        path.unlink()
    (out / "spool" / "lock").unlink()


def write_folder(into: Path, results: Any) -> None:
    """Write a folder of results by the names that the commit has for store, result and header."""
    store = first("services.execution.result_store", "services.execution.kept")
    if hasattr(store, "ResultStore"):
        kept, result = store.ResultStore, store.StoredResult
        header = import_module("schemas.results").ResultHeader
    else:
        kept, result, header = store.Kept, store.Result, store.Header
    into.mkdir()
    head = header(
        results.version, results.created, results.site_hash, results.settings, results.seed
    )
    kept(into).put([result("0" * 64, results.crossings[0])], head)


def results_of(site: Any) -> Any:
    """Return results as the commit's own tests make them up."""
    try:
        made_up = import_module("tests.unit.viewer.found")
    except ModuleNotFoundError:
        made_up = import_module("tests.unit.test_results")
        load_results = import_module("schemas.results").Results
        return load_results(
            version="0.1.0",
            created=1.79e9,
            site_hash="0" * 16,
            settings={},
            seed=1,
            crossings=(made_up.a_crossing(),),
            bridges={"bridge-1": made_up.a_bridge()},
        )
    name = "truck-1.bridge-1.20260101T000002.905Z"
    return made_up.results_of(site, made_up.some_crossing(name), used=name)


if __name__ == "__main__":
    if sys.argv[1] == "--of":
        write(Path(sys.argv[2]), Path(sys.argv[3]))
    else:
        extracted_and_run(sys.argv[1])
