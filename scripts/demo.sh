#!/usr/bin/env bash
# Sets everything up and runs `holotorch demo`; arguments go to it.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/setup.sh ""
.venv/bin/holotorch demo "$@"
echo "To go on:  . .venv/bin/activate; holotorch run configs/pec/fourier.yaml" >&2
