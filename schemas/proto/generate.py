"""Write `driveby_pb2.py` and `.pyi` from `driveby.proto`: `python -m schemas.proto.generate`.

This needs grpcio-tools (in the development requirements). A test generates into another folder and
compares, so the committed code cannot drift from the .proto file.
"""

import sys
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROTO = "schemas/proto/driveby.proto"
GENERATED = ("schemas/proto/driveby_pb2.py", "schemas/proto/driveby_pb2.pyi")


def generate(out: Path) -> None:
    """Generate the files of `GENERATED` below the folder `out`; RuntimeError if protoc fails."""
    protoc = import_module("grpc_tools.protoc")  # without types, and not installed for users

    # The .proto is named by its path from the repository, so that its descriptor has a name of its
    # own in the one pool that all protobuf packages of a process share.
    arguments = ["protoc", f"-I{ROOT}", f"--python_out={out}", f"--pyi_out={out}", PROTO]
    if protoc.main(arguments) != 0:
        raise RuntimeError(f"protoc failed on {PROTO}")
    stub = out / GENERATED[1]
    # protoc writes a bare `Mapping`, which strict type checking refuses.
    stub.write_text('# mypy: disable-error-code="type-arg"\n' + stub.read_text())


if __name__ == "__main__":
    generate(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT)
