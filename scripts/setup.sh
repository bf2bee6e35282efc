# Sourced by demo.sh and test.sh: makes .venv and installs into it, again only when pyproject.toml or the constraints
# have changed. Needs python3 (3.11 or newer) with pip and venv. Usage: . scripts/setup.sh [EXTRAS]
fail() { printf '%s\n' "$@" >&2; exit 1; }

find_python() {
    for name in python3 python3.14 python3.13 python3.12 python3.11 python; do
        if command -v "$name" >/dev/null 2>&1 && "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
        then printf '%s' "$name"; return; fi
    done
}

explain() {  # the last lines of a failed installation, and what they usually mean
    tail -n 5 "$1" >&2
    if grep -qiE 'no space left|disk quota' "$1"; then
        fail "The disk is full: about 3 GB are needed here for the CPU build of torch, 8 GB for the CUDA build."
    elif grep -qiE 'name resolution|failed to establish|connection|timed out|network is unreachable|proxy' "$1"; then
        fail "A package index could not be reached. Connect to the network, or point pip to a mirror (PIP_INDEX_URL)."
    fi
    fail "Installation failed; the whole output is in $1."
}

reachable() {  # whether each of these addresses answers, be it with a refusal; pip would retry for each package
    "$python" - "$@" <<'END'
import sys, urllib.error, urllib.request
for address in [given for given in sys.argv[1:] if given.startswith("http")]:
    try:
        urllib.request.urlopen(address, timeout=10).close()
    except urllib.error.HTTPError:
        pass
    except OSError as error:
        sys.exit(f"PIP_EXTRA_INDEX_URL {address} does not answer ({error}); installing without it, which may fetch a larger torch")
END
}

progress() {  # of pip, whose lines come in: signs of life every few seconds
    local line packages=0
    while IFS= read -r line; do
        case "$line" in
        Collecting*) packages=$((packages + 1)); [ $((packages % 10)) -ne 0 ] || echo "  $packages packages ..." ;;
        "Installing collected"*) echo "  unpacking them" ;;
        esac
    done
}

python=$(find_python)
[ -n "$python" ] || fail "Python 3.11 or newer is needed and none was found on PATH."
"$python" -c 'import venv, ensurepip' 2>/dev/null ||
    fail "$python has no venv module. Debian and Ubuntu: apt install python3-venv; Fedora: it is part of python3."

extras="${1:-}"
wanted=$( { cat pyproject.toml scripts/constraints.txt; "$python" --version; } | cksum )
case "$(cat .venv/stamp 2>/dev/null)" in
"$wanted $extras" | "$wanted [dev]") ;;  # up to date; the test tools do not disturb the demo
*)
    log=$(mktemp "${TMPDIR:-/tmp}/holotorch-install.XXXXXX") || fail "Cannot write a temporary file; is the disk full?"
    echo "Installing into .venv (a few minutes the first time; output in $log)" >&2
    rm -f .venv/stamp
    # shellcheck disable=SC2086  # several addresses are separated by spaces
    [ -z "${PIP_EXTRA_INDEX_URL:-}" ] || reachable $PIP_EXTRA_INDEX_URL || unset PIP_EXTRA_INDEX_URL
    pip="-m pip install --disable-pip-version-check -c scripts/constraints.txt"
    {
        "$python" -m venv .venv &&
            .venv/bin/python $pip -e ".$extras" &&
            printf '%s' "$wanted $extras" > .venv/stamp
    } 2>&1 | tee "$log" | progress >&2 || explain "$log"
    rm -f "$log"
    ;;
esac
