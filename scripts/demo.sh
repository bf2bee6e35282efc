#!/usr/bin/env bash
# Sets everything up and runs `holotorch demo`; arguments go to it.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/setup.sh ""
exec .venv/bin/holotorch demo "$@"
