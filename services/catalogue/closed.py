"""Catalogue rows of closed recordings, in a process of their own.

python -m services.catalogue.closed FOLDER RECORDING…
"""

import sys
from pathlib import Path

from services.catalogue.index import catalog_closed

if __name__ == "__main__":
    _folder, *_recordings = map(Path, sys.argv[1:])
    for _recording in _recordings:
        catalog_closed(_folder, _recording)
