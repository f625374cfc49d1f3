"""Parquet without what only pyarrow would want."""

import subprocess
import sys

_PROGRAM = """
import sys

import services.cli.main as command_line
from services.common.parquet_files import arrow

command_line.main = lambda: 0
command_line.program()
pa = arrow()
assert pa.array([["a"], None]).to_pylist() == [["a"], None]
assert "pandas" not in sys.modules, "imported in order to convert a list"
import pandas as pd

assert pa.table({"x": [1, 2]}).to_pandas().equals(pd.DataFrame({"x": [1, 2]}))
"""


def test_command_converts_lists_without_pandas_which_stays_usable() -> None:
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
