"""Old names of public functions, which still work but warn."""

import sys
import warnings
from collections.abc import Callable, Mapping


def renamed(module: str, names: Mapping[str, str]) -> Callable[[str], object]:
    """Return a ``__getattr__`` for ``module`` that resolves its old names with a DeprecationWarning.

    Args:
        module: ``__name__`` of the module, which defines the new names.
        names: Mapping from old to new names.
    """

    def resolve(name: str) -> object:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(f"{module}.{name} is now called {names[name]}", DeprecationWarning, stacklevel=2)
        return getattr(sys.modules[module], names[name])

    return resolve
