"""What the site of `make docs` has besides the pages of docs/: mkdocs calls the functions below.

The repository's own pages (README, ARCHITECTURE, …) stand at its root, those of the studies in
`studies/`; the reference of the Python interface and of the messages is made from the source.
"""

import inspect
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
ELSEWHERE = (
    {"README.md": "index.md"}
    | {name: name for name in ("ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")}
    | {f"studies/{path.name}": f"study-{path.name}" for path in (ROOT / "studies").glob("*.md")}
)
"""Pages outside docs/, by their names in the site."""
MADE_FROM = {"schemas/proto/driveby.proto": "messages.md", "driveby/__init__.py": "api.md"}
"""Source that the site has as a page."""
_LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s:]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not in docs/."""
    pages = {
        name: _linked((ROOT / source).read_text(), str(Path(source).parent))
        for source, name in ELSEWHERE.items()
    }
    pages |= {"api.md": api_page(), "messages.md": messages_page()}
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links of docs/ to what stands above it."""
    if page.file.src_uri in ELSEWHERE.values():
        return markdown
    folder = Path(page.file.src_uri).parent
    return _linked(markdown, f"docs/{folder}", "../" * len(folder.parts))


def api_page() -> str:
    """Every name of `import driveby` with its signature and its docstring."""
    sys.path.insert(0, str(ROOT))
    import driveby

    parts = ["# The Python interface", "Made from the docstrings; [how to use it](python.md)."]
    for name in sorted(driveby.__all__):
        value = getattr(driveby, name)
        if not callable(value):
            parts += [f"## {name}", f"```python\n{name} = {value!r}\n```"]
            continue
        parts += [f"## {name}", f"```python\n{name}{_signature(value)}\n```", _docstring(value)]
        if inspect.isclass(value):
            for member, method in sorted(vars(value).items()):
                if inspect.isfunction(method) and not member.startswith("_") and method.__doc__:
                    shown = f"```python\n{member}{_signature(method)}\n```"
                    parts += [f"### {name}.{member}", shown, _docstring(method)]
    return "\n\n".join(parts) + "\n"


def messages_page() -> str:
    """The definition of all messages, with every field's number, type and unit."""
    definition = (ROOT / "schemas/proto/driveby.proto").read_text()
    return (
        "# Messages\n\nEvery field of every message on the bus, as `schemas/proto/driveby.proto` "
        "defines it. [Which topic carries which](contract.md#streams), [units and axes]"
        f"(contract.md#units-and-axes).\n\n```proto\n{definition}```\n"
    )


def _signature(value: Any) -> str:
    try:
        return str(inspect.signature(value))
    except ValueError:
        return "(…)"


def _docstring(value: Any) -> str:
    return inspect.cleandoc(value.__doc__ or "").replace("`docs/", "`")


def _linked(text: str, where: str, up: str = "") -> str:
    """Links as the site needs them: of a page that stands in the folder `where` of the repository.

    `up` leads from the page to the root of the site.
    What is no page and not in docs/ is in the checkout only: its name stays, without a link.
    """

    def mended(found: re.Match[str]) -> str:
        words, target, anchor = found.groups(default="")
        path = (ROOT / where / target).resolve()
        if not path.exists():
            return found[0]
        name = path.relative_to(ROOT).as_posix()
        if page := (ELSEWHERE | MADE_FROM).get(name):
            return f"[{words}]({up}{page}{anchor})"
        if name.startswith("docs/"):
            return f"[{words}]({up}{name.removeprefix('docs/')}{anchor})"
        return words

    return _LINK.sub(mended, text)
