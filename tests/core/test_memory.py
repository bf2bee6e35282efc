"""What does not fit into memory is refused before anything is allocated, by a message with sizes and a cure."""

import math
import re
from pathlib import Path

import pytest
import torch

from holotorch import Grid
from holotorch.cli import main
from holotorch.core import checks, memory
from holotorch.core.memory import available_memory
from holotorch.optics import (
    AngularSpectrum,
    Aperture,
    ConvergingFresnel,
    Display,
    Eye,
    EyeLens,
    Fresnel,
    Lens,
    PixelShape,
    Retina,
    plan_retina,
    propagate_collapsed,
    propagate_elements,
    retinal_image,
    spectral_image,
)
from holotorch.optics.viewing.elementwise import ElementSampling
from holotorch.optics.viewing.imaging import CollapseSampling, collapse_sampling, pupil_bands

pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
WAVE, HUGE = 530e-9, Grid(10**7, 8e-6)
GRID, LOOK = Grid(512, 8e-6), (Display(20e-3, 25e-3, 50e-3), Eye(pupil_radius=8e-3, accommodation=0.3))
NOTHING = torch.zeros(1, dtype=torch.complex64)  # expanded to any shape it takes 8 bytes
FIELD = NOTHING.expand(1, *GRID.shape)


@pytest.fixture
def available(monkeypatch):
    def set_available(value: int | None) -> None:
        monkeypatch.setattr(memory, "available_memory", lambda device="cpu": value)

    return set_available


def test_the_border_is_what_is_available(available):
    available(10**9)
    checks.affordable(10**9, "it", "use less")
    with pytest.raises(MemoryError, match="^it needs about 1.5 GB of memory and 1 GB are available; use less$"):
        checks.affordable(1.5e9, "it", "use less")
    available(None)  # a system that does not say
    checks.affordable(1e18, "it", "use less")


def test_a_small_operation_does_not_ask(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda device: pytest.fail("asked"))
    checks.affordable(10**6, "it", "use less")


def test_this_machine_says_what_it_has():
    found = available_memory()
    assert found is not None and 1e8 < found < 1e14
    assert available_memory("meta") is None


def test_a_container_is_held_to_its_limit(tmp_path: Path):
    assert memory._container_limit(tmp_path) > 1e18
    for name, text in (
        ("memory.max", "max\n"),
        ("memory.current", "600\n"),
        ("memory.stat", "anon 1\ninactive_file 50\n"),
    ):
        (tmp_path / name).write_text(text)
    assert memory._container_limit(tmp_path) > 1e18
    (tmp_path / "memory.max").write_text("1000\n")
    assert memory._container_limit(tmp_path) == 450


COLLAPSE = CollapseSampling((64, 64), (520, 520), (516, 516), (10**6, 10**6))
ELEMENTS = ElementSampling((64, 64), (512, 512), (10**6, 10**6))
REFUSED = {
    "a lens on 10000000 x 10000000 samples in 1 channel": lambda: Lens(HUGE, WAVE, 0.1),
    "an aperture on 10000000 x 10000000 samples": lambda: Aperture(HUGE, WAVE, 1e-3),
    "the lens of an eye on 10000000 x 10000000 samples in 2 ": lambda: EyeLens(HUGE, (WAVE, 630e-9), Eye()),
    "the kernel of AngularSpectrum on 5120000 x 5120000 samp": lambda: AngularSpectrum(GRID, WAVE, 1e-2, pad=1e4),
    "the kernel of Fresnel on 512000000 x 512 samples in 1 c": lambda: Fresnel(GRID, WAVE, 1e-2, pad=(1e6, 1)),
    "ConvergingFresnel from 512 x 512 to 100000000000 x 1000": lambda: ConvergingFresnel(
        GRID, WAVE, 0.1, 0.2, out_grid=Grid(10**11, 1e-9)
    ),
    "PixelShape with orders=10 on 672 x 672 samples needs ab": lambda: PixelShape(Grid(32, 8e-6), orders=10)(
        NOTHING.expand(10**8, 1, 32, 32)
    ),
    "propagate_collapsed() on an object plane of 1000000 x 1000000 sample": lambda: propagate_collapsed(
        FIELD, GRID, WAVE, *LOOK, sampling=COLLAPSE
    ),
    "propagate_elements() on 1000000 x 1000000 samples, 64 tim": lambda: propagate_elements(
        FIELD, GRID, WAVE, *LOOK, sampling=ELEMENTS
    ),
}


@pytest.mark.parametrize("begin", REFUSED)
def test_more_than_any_machine_has_is_refused(begin):
    with pytest.raises(MemoryError, match=r" needs about .* GB of memory and .* GB are available; \w+") as caught:
        REFUSED[begin]()
    assert str(caught.value).startswith(begin)


def test_the_observer_is_refused_what_a_wide_pupil_takes(available):
    """3.06 GB, measured; the spectrum that the pupil takes has 11 x 11 bands of the hologram's pitch."""
    display, eye = LOOK
    plane = display.focus_plane(eye.accommodation)
    sizes, bands = collapse_sampling(GRID, [WAVE], *LOOK, plane), pupil_bands(GRID, WAVE, *LOOK, plane)
    assert bands == (11, 11)
    needed = sizes.memory_bytes(math.prod(bands) * math.prod(sizes.window))
    assert needed == pytest.approx(3.06e9, rel=0.15)
    retina = Retina(GRID, WAVE, *LOOK)
    available(min(needed, retina.plan.memory_bytes) // 2)
    for call in (
        lambda: retina(FIELD),
        lambda: retinal_image(FIELD, GRID, WAVE, *LOOK),
        lambda: propagate_collapsed(FIELD, GRID, WAVE, *LOOK),
        lambda: propagate_elements(FIELD, GRID, WAVE, *LOOK),
        lambda: spectral_image(FIELD[0], GRID, [WAVE], [1.0], *LOOK, count=1),
    ):
        with pytest.raises(MemoryError, match="GB are available; (crop|use propagate_collapsed)"):
            call()


def test_more_fields_at_once_need_more():
    display, eye = Display(20e-3, 25e-3, 50e-3), Eye()
    plan = plan_retina(GRID, WAVE, display, eye)
    many = NOTHING.expand(10**7, 1, *GRID.shape)
    with pytest.raises(MemoryError) as caught:
        propagate_collapsed(many, GRID, WAVE, display, eye)
    needed = float(re.findall(r"about (\S+) GB", str(caught.value))[0]) * 1e9
    assert needed > 1e5 * plan.memory_bytes and math.isfinite(needed)


def test_the_command_line_says_what_was_refused(monkeypatch, capsys):
    def refused(*_):
        checks.affordable(1e18, "a lens on 9 x 9 samples", "use a smaller grid")

    monkeypatch.setattr("holotorch.cli._run", refused)
    assert main(["run", "some.yaml"]) == 1
    assert capsys.readouterr().err.startswith("a lens on 9 x 9 samples needs about 1e+09 GB of memory and ")
