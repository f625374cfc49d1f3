"""What `make mutants` changes: one token at a time, and nothing that only a type checker reads."""

from pathlib import Path

from tests.mutants.imports import distances_to, imports_of
from tests.mutants.mutate import mutants
from tests.mutants.run import draw

SOURCE = '''
def f(δ: int = 0, *rest: float, path=None) -> "a + b":
    """Not 0 < 1."""
    if not δ < 1 and rest is not None or min(δ, -2) == (3 + 4) * 5:
        return f"{1 + δ}", path / "0 + 1"
    return np.maximum(δ, 1.0) / 2
if __name__ == "__main__":
    f(0)
'''


def test_each_mutant_differs_in_the_one_token() -> None:
    found = [(m.old, m.new) for m in mutants(SOURCE)]
    assert found == [
        ("0", "1"),
        ("not", ""),
        ("<", "<="),
        ("1", "0"),
        ("and", "or"),
        ("not", ""),
        ("or", "and"),
        ("min", "max"),
        ("-", ""),
        ("==", "!="),
        ("+", "-"),
        ("*", "/"),
        ("maximum", "minimum"),
        ("1.0", "0.0"),
        ("/", "*"),
    ]
    for mutant in mutants(SOURCE):
        changed = mutant.apply(SOURCE)
        compile(changed, "mutant", "exec")
        assert changed == SOURCE.replace(
            changed_line(SOURCE, changed), changed_line(changed, SOURCE)
        )


def changed_line(text: str, other: str) -> str:
    [line] = set(text.splitlines()) - set(other.splitlines())
    return line


def test_a_sample_is_of_all_rooms_and_the_same_each_time(project: Path) -> None:
    files = [str(path.relative_to(project)) for path in (project / "services").rglob("*.py")]
    sample = draw(sorted(files), 40, seed=3)
    assert sample == draw(sorted(files), 40, seed=3)
    assert sample != draw(sorted(files), 40, seed=4)
    assert len(set(sample)) == 40
    rooms = {path.name for path in (project / "services").iterdir() if any(path.glob("*.py"))}
    assert rooms - {drawn.file.split("/")[1] for drawn in sample} == set()


def test_imports_show_which_tests_are_near(tmp_path: Path) -> None:
    texts = {
        "a/__init__.py": "",
        "a/one.py": "import os",
        "a/two.py": "from a import one",
        "t/test_two.py": "def f():\n    from a.two import x",
        "t/test_none.py": "import a",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    away = distances_to(imports_of(tmp_path, texts), "a/one.py")
    assert away == {"a/one.py": 0, "a/two.py": 1, "t/test_two.py": 2}
