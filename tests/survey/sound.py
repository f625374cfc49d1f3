"""How often `driveby check` speaks against sound drives, drawn widely.

python -m tests.survey.sound [DRIVES]
"""

import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from schemas.site_file import site_toml
from services.inspection.finding import CheckStatus
from services.inspection.inspect import findings_of_run
from services.inspection.recorded import recorded_runs
from services.recordings.writer import write_recording
from tests.verdicts import faults


def main() -> None:
    drives = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    counts: Counter[str] = Counter()
    accused = 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        for seed in range(drives):
            case = faults.crossing(
                faults.drawn(seed), faults.Fault(site=faults.believed_nearly(seed))
            )
            text = site_toml(case.site)
            write_recording(path, case.messages, site_toml=text, reason="test", force=True)
            (run,) = recorded_runs(path, case.site, "site.toml")
            outcome = [f for f in findings_of_run(run, case.site) if f.state is not CheckStatus.OK]
            wrong = [f for f in outcome if f.state is CheckStatus.WRONG]
            accused += bool(wrong)
            counts.update(f"{f.state.value} {f.name}" for f in outcome)
            for finding in wrong:
                print(f"{seed}: {finding.text}", flush=True)
    print(f"{accused} of {drives} sound drives accused; {dict(counts)}")


if __name__ == "__main__":
    main()
