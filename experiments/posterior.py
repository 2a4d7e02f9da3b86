"""The old name of `python -m experiments.calibrate`."""

import shlex
import sys

if __name__ == "__main__":
    command = shlex.join(["python", "-m", "experiments.calibrate", *sys.argv[1:]])
    print(f"error: experiments.posterior is now experiments.calibrate: {command}", file=sys.stderr)
    sys.exit(2)
