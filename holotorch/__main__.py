"""Entry point of ``python -m holotorch``, the form in which ``torchrun`` starts the program."""

import sys

from holotorch.cli import main

sys.exit(main())
