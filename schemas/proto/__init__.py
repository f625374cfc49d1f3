"""Protocol Buffers: `driveby.proto` and the code generated from it (see `generate.py`)."""
