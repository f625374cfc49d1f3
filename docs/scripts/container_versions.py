"""Says in one line what is too old for compose.yaml; exit code 0 if nothing is. `make up` runs it.

    python docs/scripts/container_versions.py

Needs nothing but Python: it runs before anything is installed.
"""

import re
import subprocess
import sys

NEEDED = {
    "Docker Engine": ((26, 0), ("docker", "version", "--format", "{{.Server.Version}}")),
    "Docker Compose": ((2, 26), ("docker", "compose", "version", "--short")),
}
"""The first that mount a folder inside a volume (`volume.subpath`): each service gets its own
credentials and nobody else's."""


def problem(name: str, needed: tuple[int, int], command: tuple[str, ...]) -> str | None:
    """Say what is wrong with a program, None if it is there and new enough."""
    wanted = f"{name} {needed[0]}.{needed[1]} or newer is needed"
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except FileNotFoundError:
        return f"{wanted}, but there is no program docker"
    except subprocess.TimeoutExpired:
        return f"{wanted}, but `{' '.join(command)}` does not answer"
    found = re.match(r"v?(\d+)\.(\d+)", done.stdout.strip())
    if done.returncode != 0 or found is None:
        answer = " ".join((done.stderr or done.stdout).split())[:200]
        return f"{wanted}, but `{' '.join(command)}` says: {answer or 'nothing'}"
    if (int(found[1]), int(found[2])) < needed:
        return f"{wanted}, this is {done.stdout.strip()}"
    return None


def main() -> int:
    """Check both and print the first problem."""
    for name, (needed, command) in NEEDED.items():
        wrong = problem(name, needed, command)
        if wrong:
            sys.stderr.write(wrong + "\n")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
