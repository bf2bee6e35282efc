"""The two set-up scripts say plainly what is missing. They run here with a stand-in for python3, without a network."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from paths import ROOT

NEEDED = ("bash", "cat", "cksum", "dirname", "mktemp", "rm", "tail", "tee", "grep", "mkdir", "chmod")


@pytest.fixture
def checkout(tmp_path):
    """A copy of what the scripts read, and a PATH on which only a shell's basic tools are found."""
    for name in ("pyproject.toml", "scripts/setup.sh", "scripts/demo.sh", "scripts/test.sh", "scripts/constraints.txt"):
        target = tmp_path / "clone" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, target)
    (tmp_path / "bin").mkdir()
    for name in NEEDED:
        found = shutil.which(name)
        assert found
        (tmp_path / "bin" / name).symlink_to(found)
    return tmp_path


def stand_in(checkout: Path, body: str) -> None:
    path = checkout / "bin" / "python3"
    path.write_text(f"#!/usr/bin/env bash\n{body}\n")
    path.chmod(0o755)


def call(checkout: Path, script: str = "demo.sh", *words: str, **variables: str):
    environment = {"PATH": str(checkout / "bin"), "TMPDIR": str(checkout), "HOME": str(checkout)} | variables
    command = [str(checkout / "bin" / "bash"), f"scripts/{script}", *words]
    return subprocess.run(command, cwd=checkout / "clone", env=environment, capture_output=True, text=True)


# Answers the script's questions well; "python3 -m venv" makes a python whose pip does as PIP says.
WORKING = """
case "$*" in
  *--version*) echo "Python 3.11.9" ;;
  "-m venv .venv") mkdir -p .venv/bin; printf '#!/usr/bin/env bash\\n%s\\n' 'PIP' > .venv/bin/python
                   chmod +x .venv/bin/python ;;
esac
exit 0
"""


@pytest.mark.parametrize(
    ("python", "message"),
    [
        (None, "Python 3.11 or newer is needed and none was found on PATH."),
        ("exit 1", "Python 3.11 or newer is needed and none was found on PATH."),
        (
            '[[ "$*" == *ensurepip* ]] && exit 1; exit 0',
            "has no venv module. Debian and Ubuntu: apt install python3-venv",
        ),
        (WORKING.replace("PIP", "echo No space left on device; exit 1"), "The disk is full: about 3 GB are needed"),
        (
            WORKING.replace("PIP", "echo Temporary failure in name resolution; exit 1"),
            "A package index could not be reached",
        ),
        (WORKING.replace("PIP", "echo something else; exit 1"), "Installation failed; the whole output is in"),
    ],
    ids=["no python", "old python", "no venv", "disk full", "no network", "anything else"],
)
@pytest.mark.parametrize("script", ["demo.sh", "test.sh"])
def test_says_what_is_missing(checkout, script, python, message):
    if python:
        stand_in(checkout, python)
    done = call(checkout, script)
    assert done.returncode == 1 and message in done.stderr
    assert not (checkout / "clone" / ".venv" / "stamp").exists()


def test_installs_once_and_again_when_the_constraints_change(checkout):
    stand_in(checkout, WORKING.replace("PIP", 'echo "$*" >> ../calls'))
    holotorch = checkout / "clone" / ".venv" / "bin" / "holotorch"
    holotorch.parent.mkdir(parents=True)
    holotorch.write_text('#!/usr/bin/env bash\necho "holotorch $*"\n')
    holotorch.chmod(0o755)

    def installs() -> list[str]:
        calls = (checkout / "calls").read_text().splitlines()
        return [line.split()[-1] for line in calls if " install " in line]

    assert call(checkout, "demo.sh", "--out", "x").stdout == "holotorch demo --out x\n"
    assert call(checkout).returncode == 0
    assert installs() == ["."]
    call(checkout, "test.sh")
    call(checkout, "demo.sh")  # the test tools do not disturb the demo
    assert installs() == [".", ".[dev]"]
    with open(checkout / "clone" / "scripts" / "constraints.txt", "a") as stream:
        stream.write("# changed\n")
    call(checkout, "demo.sh")
    assert installs() == [".", ".[dev]", "."]


@pytest.mark.parametrize("answers", [True, False])
def test_an_extra_index_that_does_not_answer_is_left_out(checkout, tmp_path, answers):
    """pip would retry it for every package, for minutes and without a word."""
    real = f'[ "$1" = - ] && exec {sys.executable} "$@"\n'
    stand_in(checkout, real + WORKING.replace("PIP", 'echo "extra: $PIP_EXTRA_INDEX_URL" >> ../calls'))
    index = tmp_path.as_uri() if answers else "http://127.0.0.1:9/whl/cpu"
    done = call(checkout, PIP_EXTRA_INDEX_URL=index)
    assert (checkout / "calls").read_text().splitlines()[0] == f"extra: {index if answers else ''}"
    assert (f"PIP_EXTRA_INDEX_URL {index} does not answer" in done.stderr) is not answers


def test_a_long_installation_shows_that_it_goes_on(checkout):
    pip = 'for i in {1..25}; do echo "Collecting p$i"; done; echo "Installing collected packages: p1"'
    stand_in(checkout, WORKING.replace("PIP", pip.replace("'", "")))
    said = call(checkout).stderr.splitlines()
    assert said[1:4] == ["  10 packages ...", "  20 packages ...", "  unpacking them"]


def test_all_tests_run_in_several_processes_and_chosen_ones_in_one(checkout):
    stand_in(checkout, WORKING.replace("PIP", 'echo "$*, threads: $OMP_NUM_THREADS" >> ../calls'))
    assert call(checkout, "test.sh").returncode == 0
    assert call(checkout, "test.sh", "-k", "name", "tests/core").returncode == 0
    whole, chosen = (checkout / "calls").read_text().splitlines()[-2:]
    assert whole.startswith("-m pytest ") and "--numprocesses auto" in whole and "--dist loadfile" in whole
    assert chosen == "-m pytest -k name tests/core, threads: 1"


def test_scripts_are_executable():
    for name in ("scripts/demo.sh", "scripts/test.sh", ".ci/run"):
        assert os.access(ROOT / name, os.X_OK)
