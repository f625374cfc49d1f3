"""compose.yaml with the values that its variables have where they are not set."""

import re


def with_defaults(text: str) -> str:
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)
