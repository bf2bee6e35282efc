"""Where the checkout and its data lie, and the devices of this machine, for tests in any folder."""

from pathlib import Path

import torch

import holotorch

ROOT = Path(__file__).parents[1]
PACKAGE = Path(holotorch.__file__).parent  # beside the tests, or installed
CONFIGS = ROOT / "configs"
SHARED = ROOT.parent / "shared" / "data"  # data that lies beside some checkouts; tests that use it skip without it
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
