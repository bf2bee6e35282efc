import pytest
import torch
from stand_in import CAMERA, SIZE, StandIn
from undrawn import Blank, without_figures

from holotorch.experiments.runs import figures
from holotorch.experiments.tracking import source as track_source
from holotorch.experiments.tracking.devices import save_camera, save_catheter
from holotorch.tracking import THESIS


@pytest.fixture
def no_figures():
    """For runs whose figures another test has drawn, or the same run before."""
    with without_figures():
        yield


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are composed as ever, but not turned into pixels, which takes longer than a small run."""
    monkeypatch.setattr(figures, "FigureCanvasAgg", Blank)


@pytest.fixture(scope="module")
def tiny():
    """For tiny runs: no figures, which take longer than they do, and one thread, as two would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with without_figures():
        yield
    torch.set_num_threads(threads)


@pytest.fixture
def tracker(monkeypatch, tmp_path):
    """The stand-in, in place of whatever tracker a run asks for, with a camera's and a catheter's file."""
    made = StandIn()
    save_camera(tmp_path / "camera.yaml", CAMERA, SIZE)
    save_catheter(tmp_path / "catheter.yaml", THESIS)
    monkeypatch.setattr(track_source, "make_tracker", lambda *_: made)
    return made
