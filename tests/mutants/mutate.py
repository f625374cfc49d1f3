"""One-token mutants of a Python file: where they are and what they say instead.

The syntax tree says what a token is (a minus that subtracts or one that negates), the tokens say
where it stands. Left alone: type annotations, f-strings (their inner positions are not known
before Python 3.12), `/` between paths, and what runs under `if __name__ == "__main__"`.
"""

import ast
import io
import tokenize
from bisect import bisect_left
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import NamedTuple

BINARY = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
COMPARED = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
JOINED = {ast.And: ("and", "or"), ast.Or: ("or", "and")}
NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}
NUMBERS = {"0": "1", "1": "0", "0.0": "1.0", "1.0": "0.0"}
ANNOTATIONS = {"annotation", "returns"}

Place = tuple[int, int]
"""Line from 1, column in characters from 0."""


class Mutant(NamedTuple):
    line: int
    column: int
    old: str
    new: str

    def apply(self, source: str) -> str:
        lines = source.splitlines(keepends=True)
        line = lines[self.line - 1]
        assert line.startswith(self.old, self.column)
        lines[self.line - 1] = line[: self.column] + self.new + line[self.column + len(self.old) :]
        return "".join(lines)


@cache
def mutants(source: str) -> tuple[Mutant, ...]:
    """Every mutant of a file, in the order of their places."""
    lines = source.splitlines(keepends=True)
    tokens = [
        token
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type in (tokenize.OP, tokenize.NAME, tokenize.NUMBER)
    ]
    starts = [token.start for token in tokens]

    def place(line: int, column_bytes: int) -> Place:
        # ast counts bytes, tokenize characters.
        return line, len(lines[line - 1].encode()[:column_bytes].decode())

    def at(node: ast.expr, old: str, new: str) -> Iterator[Mutant]:
        begin = place(node.lineno, node.col_offset)
        yield from between(begin, (begin[0], begin[1] + 1), old, new)

    def gap(left: ast.expr, right: ast.expr, old: str, new: str) -> Iterator[Mutant]:
        assert left.end_lineno is not None
        assert left.end_col_offset is not None
        begin = place(left.end_lineno, left.end_col_offset)
        yield from between(begin, place(right.lineno, right.col_offset), old, new)

    def between(begin: Place, end: Place, old: str, new: str) -> Iterator[Mutant]:
        for token in tokens[bisect_left(starts, begin) : bisect_left(starts, end)]:
            if token.string == old:
                yield Mutant(*token.start, old, new)
                return

    def of(node: ast.AST) -> Iterator[Mutant]:
        match node:
            case ast.BinOp(left, op, right) if type(op) in BINARY and not _of_texts(left, right):
                yield from gap(left, right, *BINARY[type(op)])
            case ast.BoolOp(op, values):
                for left, right in pairwise(values):
                    yield from gap(left, right, *JOINED[type(op)])
            case ast.Compare(left, operators, others):
                for one, op, other in zip([left, *others], operators, others, strict=False):
                    if isinstance(op, ast.IsNot | ast.NotIn):
                        yield from gap(one, other, "not", "")
                    else:
                        for old, new in COMPARED.items():
                            yield from gap(one, other, old, new)
            case ast.UnaryOp(ast.Not()):
                yield from at(node, "not", "")
            case ast.UnaryOp(ast.USub()):
                yield from at(node, "-", "")
            case ast.Constant() if type(node.value) in (int, float):
                for old, new in NUMBERS.items():
                    yield from at(node, old, new)
            case ast.Name(name) if name in NAMES:
                yield from at(node, name, NAMES[name])
            case ast.Attribute(value, name) if name in NAMES:
                assert value.end_lineno is not None
                assert value.end_col_offset is not None
                begin = place(value.end_lineno, value.end_col_offset)
                yield from between(begin, (begin[0] + 1, 0), name, NAMES[name])

    return tuple(sorted({mutant for node in _walk(ast.parse(source)) for mutant in of(node)}))


def _walk(node: ast.AST) -> Iterator[ast.AST]:
    yield node
    for name, value in ast.iter_fields(node):
        if name not in ANNOTATIONS:
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and not _is_left_alone(child):
                    yield from _walk(child)


def _is_left_alone(node: ast.AST) -> bool:
    if isinstance(node, ast.If):
        return "__name__" in ast.unparse(node.test) or "TYPE_CHECKING" in ast.unparse(node.test)
    return isinstance(node, ast.JoinedStr)


def _of_texts(left: ast.expr, right: ast.expr) -> bool:
    """Whether texts are joined or a path is made: all that can come of it is a TypeError."""
    return any(
        isinstance(side, ast.JoinedStr)
        or (isinstance(side, ast.Constant) and isinstance(side.value, str | bytes))
        for side in (left, right)
    )
