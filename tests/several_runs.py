"""Runs one after another in the processes that ``torchrun`` has started, which load torch once for all of them.

``python -m torch.distributed.run ... several_runs.py FILE``: the file holds the words of the command line for each run,
in JSON.
"""

import json
import os
import sys
from functools import partial
from pathlib import Path

import torch

from holotorch.cli import main

if __name__ == "__main__":
    connect = torch.distributed.init_process_group
    place = {"rank": int(os.environ["RANK"]), "world_size": int(os.environ["WORLD_SIZE"])}
    for number, words in enumerate(json.loads(Path(sys.argv[1]).read_text())):
        # The store of torchrun joins processes once; each run has a store of its own.
        store = f"file://{sys.argv[1]}.{number}"
        torch.distributed.init_process_group = partial(connect, init_method=store, **place)
        print(f"status {main(words)} of {words[-1]}", flush=True)
