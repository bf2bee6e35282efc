"""Mutated inputs for every parser and server.

Usage: python scripts/fuzz.py [TARGET ...] --seconds 600 --seed 1

Each target runs for so many seconds. What fails is kept in OUT/failures/TARGET-NUMBER, with its symptom, and made again
by: python scripts/fuzz.py TARGET --seed SEED --first NUMBER --inputs 1
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# In the place of this folder, whose fuzz.py would hide the package of that name.
sys.path[:1] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests")]


def main() -> int:
    """Run the targets one after another, and print a table; 1 where something failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="all by default; --list shows them")
    parser.add_argument("--seconds", type=float, default=60.0, help="per target (default: 60)")
    parser.add_argument("--inputs", type=int, help="per target, instead of as many as there is time for")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, metavar="NUMBER", help="the input to begin with")
    parser.add_argument("--out", type=Path, help="where failures are kept (default: a new temporary folder)")
    parser.add_argument("--list", action="store_true", help="name the targets and end")
    options = parser.parse_args()
    from fuzz.engine import fuzz
    from fuzz.targets import TARGETS

    if options.list:
        print("\n".join(TARGETS))
        return 0
    if unknown := [name for name in options.targets if name not in TARGETS]:
        parser.error(f"no target {', '.join(unknown)}; there are {', '.join(TARGETS)}")
    folder = (options.out or Path(tempfile.mkdtemp(prefix="fuzz-"))).resolve()
    failed = 0
    print(f"{'target':24}{'inputs':>9}{'refused':>9}{'accepted':>9}{'failures':>9}")
    for name in options.targets or TARGETS:
        count = fuzz(
            TARGETS[name],
            folder,
            seconds=options.seconds,
            inputs=options.inputs,
            seed=options.seed,
            first=options.first,
        )
        failed += len(count.failures)
        numbers = (count.inputs, count.refused, count.accepted, len(count.failures))
        print(f"{name:24}" + "".join(f"{number:9}" for number in numbers), flush=True)
        for number, symptom in list(count.failures.items())[:5]:
            last = symptom.strip().splitlines()[-1]
            print(f"    input {number}: {last[:200]}", flush=True)
    if failed:
        print(f"{failed} failures, kept in {folder / 'failures'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
