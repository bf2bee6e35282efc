"""Signals at random moments of runs of every kind.

Usage: python scripts/kills.py --kills 200 --seed 1

What fails is kept in OUT/failed-NUMBER, and made again by: python scripts/kills.py --seed SEED --first NUMBER --kills 1
"""

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# In the place of this folder, whose kills.py and fuzz.py would hide what is imported.
sys.path[:1] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests")]


def main() -> int:
    """Run the cases one after another, and print what fails; 1 where something does."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, help="runs that are ended by a signal (default: 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, metavar="NUMBER", help="the case to begin with")
    parser.add_argument("--kind", help="one kind only")
    parser.add_argument("--out", type=Path, help="where failures are kept (default: a new temporary folder)")
    options = parser.parse_args()
    from fuzz.kills import KINDS, Kills

    if options.kind not in (None, *KINDS):
        parser.error(f"no kind {options.kind}; there are {', '.join(KINDS)}")
    kills = Kills((options.out or Path(tempfile.mkdtemp(prefix="kills-"))).resolve(), options.seed)
    began, done, failed, signals = time.monotonic(), Counter[str](), 0, 0
    number = options.first
    while signals < options.kills:
        kind, shots = kills.case(number, options.kind)
        done[kind], signals = done[kind] + 1, signals + len(shots)
        if symptom := kills.run(number, options.kind):
            failed += 1
            print(f"case {number}: {symptom}", flush=True)
        number += 1
    told = ", ".join(f"{count} {kind}" for kind, count in sorted(done.items()))
    print(f"{signals} signals in {number - options.first} runs ({told}), {failed} failures", end="")
    print(f", {time.monotonic() - began:.0f} s" + (f"; kept in {kills.folder}" if failed else ""))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
