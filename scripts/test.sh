#!/usr/bin/env bash
# Sets everything up and runs the tests: all of them in one process per core, or in one process what arguments to pytest
# choose.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/setup.sh "[dev]"
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"  # threads of several processes wait for each other
# By files, whose tests share what they set up; at most 8, as each process holds torch and the largest test's memory.
[ $# -gt 0 ] || set -- --numprocesses auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder
exec .venv/bin/python -m pytest "$@"
