"""The command `driveby import`: files of a drive as a recording."""

from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.drives.settings import ImportOptions


def _import(asked: ImportOptions) -> int:
    return _preview(asked) if asked.writes_no_recording else _write_recording(asked)


def _preview(asked: ImportOptions) -> int:
    """Print a drive as it is read; write its map if requested."""
    from services.common.errors import InputError
    from services.common.files import write_atomically
    from services.drives.importing import interpreted_drive
    from services.drives.tables.mapping import map_text
    from services.drives.tables.preview import preview_lines

    try:
        found = interpreted_drive(asked)
    except InputError as error:
        if asked.write_map is None:
            raise
        raise InputError(f"{error}; {asked.write_map} was not written") from error
    if asked.preview:
        print("\n".join(preview_lines(found, a_console().width)))
    if asked.picture is not None:
        from services.viewer.drive_figure import run_picture

        write_atomically(asked.picture, run_picture(found.runs[0]))
        print(asked.picture)
    if asked.write_map is not None:
        write_atomically(asked.write_map, map_text(found.mapping))
        has_hole = any(one.kind == "open" for one in found.guesses)
        todo = "fill in what is missing and check it" if has_hole else "check it"
        print(f"{asked.write_map}: {todo}, then driveby import --map {asked.write_map}")
    return 0


def _write_recording(asked: ImportOptions) -> int:
    from rich.console import Console

    from services.catalogue.index import catalog_above, catalog_closed
    from services.common.errors import InputError
    from services.common.progress import progress_bar
    from services.drives.importing import import_command

    output = asked.output
    if output is None:
        raise InputError("the following arguments are required: -o/--output, or --preview")
    with progress_bar(Console(stderr=True)) as bar:
        reading = bar.add_task("reading", total=None)
        writing = bar.add_task(f"writing {output}", total=None, visible=False)
        summary = import_command(
            asked,
            output,
            reading=lambda n, total: bar.update(reading, completed=n, total=total),
            writing=lambda n, total: bar.update(writing, completed=n, total=total, visible=True),
        )
    print(summary)
    folder = catalog_above(output)
    if folder is not None:
        catalog_closed(folder, output)
    return 0


COMMAND: Final = Subcommand(
    ImportOptions,
    "driveby import crossings/d1 --site crossings/d1/site.toml -o d1.mcap",
    _import,
)
