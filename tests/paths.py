"""Where the checkout and its data lie, for tests in any folder."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
CONFIGS = ROOT / "configs"
SHARED = ROOT.parent / "shared" / "data"  # data that lies beside some checkouts; tests that use it skip without it
