"""Print the estimates in a recording: `python decode_estimate.py RESULTS.mcap`.

It needs Protocol Buffers and MCAP only. Of this program it uses the definition of the messages, for
which `protoc` generates code in any language.
"""

import sys

from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC

from schemas.proto import driveby_pb2 as pb

with open(sys.argv[1], "rb") as file:  # noqa: PTH123 - as short as it can be
    file.seek(max(0, file.seek(0, 2) - len(MCAP0_MAGIC)))
    if file.read() != MCAP0_MAGIC:
        sys.exit(f"{sys.argv[1]}: has no end yet, or was cut off (driveby recover completes it)")
    file.seek(0)
    for _, channel, message in make_reader(file).iter_messages():
        if not channel.topic.endswith("/estimate"):
            continue
        estimate = pb.Estimate.FromString(message.data)
        print(estimate.crossing_id, pb.Verdict.Name(estimate.verdict), *estimate.reasons)
        for name, value in sorted(estimate.parameters.items()):
            if name.startswith("EI_"):
                print(f"  {name} {value.mean:.4g} ({value.q025:.4g} to {value.q975:.4g}) N·m²")
