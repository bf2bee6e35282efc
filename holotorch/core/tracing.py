"""Functions that torch.compile calls while it traces, and whose results it takes as constants."""

from collections.abc import Callable
from typing import Any, TypeVar

import torch

Function = TypeVar("Function", bound=Callable[..., Any])


def constant_when_compiled(function: Function) -> Function:
    """``torch.compiler.assume_constant_result``, which loads all of torch's compiler first, for two seconds."""
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return function


@constant_when_compiled
def is_exporting() -> bool:
    """``torch.compiler.is_exporting``, which torch.compile takes for True until torch 2.11."""
    return torch.compiler.is_exporting()
