"""Old names of public functions, which keep working for the code of users and warn."""

import sys
import warnings
from collections.abc import Callable, Mapping


def renamed(module: str, names: Mapping[str, str]) -> Callable[[str], object]:
    """Module-level ``__getattr__`` that resolves old names of ``module`` to new ones with a DeprecationWarning.

    Args:
        module: ``__name__`` of the module, which defines the new names.
        names: Old name to new name.
    """

    def resolve(name: str) -> object:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(f"{module}.{name} is now called {names[name]}", DeprecationWarning, stacklevel=2)
        return getattr(sys.modules[module], names[name])

    return resolve
