"""The committed protobuf code is that of the .proto file."""

import warnings
from pathlib import Path

import pytest

from schemas.proto.generate import GENERATED, ROOT, generate


def test_generated_code_is_in_step_with_the_proto_file(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # grpcio-tools uses pkg_resources in some versions
        pytest.importorskip("grpc_tools")
        generate(tmp_path)
    for name in GENERATED:
        assert (tmp_path / name).read_text() == (ROOT / name).read_text(), (
            f"{name} is old: run python -m schemas.proto.generate"
        )
