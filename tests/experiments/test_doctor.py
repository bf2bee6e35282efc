from importlib import metadata

import pytest

from holotorch.experiments import doctor


def test_this_installation_is_sound(capsys):
    assert doctor.diagnose()
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith("OK") for line in lines)
    for word in ("python:", "torch", "device:", "opencv:", "fft:", "exr:", "udp:", "extra:"):
        assert any(word in line for line in lines)


def test_a_second_opencv_is_found_with_its_repair(monkeypatch, capsys):
    class Fake:
        def __init__(self, name):
            self.metadata = {"Name": name}

    names = ["numpy", "opencv-python", "opencv-contrib-python-headless"]
    monkeypatch.setattr(metadata, "distributions", lambda: [Fake(name) for name in names])
    assert not doctor.diagnose()
    wanted = (
        "FAIL  opencv: opencv-python beside opencv-contrib-python-headless overwrite each other; run: pip uninstall -y "
        "opencv-python && pip install --force-reinstall --no-deps opencv-contrib-python-headless"
    )
    assert wanted in capsys.readouterr().out


def test_an_old_or_missing_package_is_named_with_the_command(monkeypatch, capsys):
    known = metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "0.1" if name == "kornia" else known(name))
    assert not doctor.diagnose()
    assert "FAIL  package: kornia>=0.9 needed, 0.1 found; run: pip install 'kornia>=0.9'" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["_fft", "_exr", "_udp"])
def test_a_check_that_breaks_is_reported_and_the_others_go_on(monkeypatch, capsys, name):
    def broken():
        raise RuntimeError("no such luck")
        yield

    key = name.removeprefix("_")
    monkeypatch.setitem(doctor._CHECKS, key, broken)
    assert not doctor.diagnose()
    out = capsys.readouterr().out
    assert f"FAIL  {key}: RuntimeError: no such luck" in out and "extra:" in out
