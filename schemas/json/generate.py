"""Write the JSON schemas from the models: `python -m schemas.json.generate` (`make tables`).

A schema accepts every valid file, and refuses unknown keys and wrong types. Relations between
values, such as axle loads that add up to the total mass, are the program's to check.
"""

import json
import sys
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from schemas.field_docs import field_docs
from schemas.results import Results
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_axles import REPLACED
from schemas.site_damping import COEFFICIENTS

FOLDER: Final = Path(__file__).parent
MODELS: Final[dict[str, type[BaseModel]]] = {
    "site": Site,
    "settings": IdentificationSettings,
    "results": Results,
}
_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_REPLACED: Final = {"Vehicle": (*REPLACED, "total_mass_kg"), "Bridge": COEFFICIENTS}
"""Required keys of a table that other keys may replace: axles, or a damping ratio."""
_ONE_OR_MORE: Final = ("vehicle", "bridge", "ros2")
"""Tables of a site file that stand alone, as [vehicle], or several times, as [[vehicle]]."""


def schema(name: str) -> dict[str, Any]:
    """Return one of the schemas of `MODELS`."""
    found = {"$schema": _DIALECT} | MODELS[name].model_json_schema()
    found["title"] = f"driveby {name}"
    known = _models()
    tables = {MODELS[name].__name__: found, **found.get("$defs", {})}
    for of, table in tables.items():
        for values in table.get("properties", {}).values():
            values.pop("title", None)
        for key, doc in _docs_by_key(known[of]).items() if of in known else ():
            if key in table.get("properties", {}):
                table["properties"][key].setdefault("description", doc)
    if name == "site":
        for of, keys in _REPLACED.items():
            table = tables[of]
            table["required"] = [key for key in table["required"] if key not in keys]
        for key in _ONE_OR_MORE:
            several = found["properties"][key]
            several["anyOf"] = [
                several["items"],
                {k: several.pop(k) for k in ("type", "items", "minItems") if k in several},
            ]
    return found


def schema_text(name: str) -> str:
    """Return the text of a schema's file."""
    return json.dumps(schema(name), indent=1, ensure_ascii=False) + "\n"


def _models() -> dict[str, type[BaseModel]]:
    """Return all models by name."""
    found, waiting = {}, [BaseModel]
    while waiting:
        for one in waiting.pop().__subclasses__():
            if one.__module__.startswith("schemas."):
                found[one.__name__] = one
            waiting.append(one)
    return found


def _docs_by_key(model: type[BaseModel]) -> dict[str, str]:
    """Return the strings below a model's fields, by the keys of the file."""
    docs: dict[str, str] = {}
    for one in reversed(model.__mro__):
        if not (issubclass(one, BaseModel) and one.__module__.startswith("schemas.")):
            continue
        for name, doc in field_docs(one):
            info = model.model_fields.get(name)
            key = (info.alias if info is not None else None) or name
            docs[key] = " ".join(doc.split())
    return docs


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    for each in MODELS:
        (folder / f"{each}.schema.json").write_text(schema_text(each), "utf-8")
