"""The forward and the inverse problem: arrays and NamedTuples in, arrays and NamedTuples out.

Nothing here opens a file or a socket, reads a clock or prints; numpy, numba and scipy are all it
imports. Units are SI throughout; `x` is the chainage of `docs/contract.md`.
"""

import numba

# The particle kernels hold four particles in tuples of four floats (lanes.py); LLVM packs them into
# vector registers only with its superword pass, which numba leaves off. It changes speed alone.
setattr(numba.config, "SLP_VECTORIZE", 1)  # noqa: B010 - the type stubs do not know it
