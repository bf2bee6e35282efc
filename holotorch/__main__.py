"""``python -m holotorch``, which torchrun needs."""

import sys

from holotorch.cli import main

sys.exit(main())
