import importlib

import pytest

RENAMED = {
    "imaged": "propagate_collapsed",
    "through_elements": "propagate_elements",
    "exposed": "tone_map",
    "desaturated": "gamut_map",
}
HOMES = {
    "imaged": "holotorch.optics.viewing.imaging",
    "through_elements": "holotorch.optics.viewing.elementwise",
    "exposed": "holotorch.optics.picture",
    "desaturated": "holotorch.optics.picture",
}


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_name_is_the_new_function_with_a_deprecation_warning(old):
    new = RENAMED[old]
    for module in map(importlib.import_module, ("holotorch.optics", HOMES[old])):
        with pytest.warns(DeprecationWarning, match=f"{old} is now called {new}"):
            assert getattr(module, old) is getattr(module, new)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'holotorch.optics' has no attribute 'no_such_name'"):
        importlib.import_module("holotorch.optics").no_such_name  # noqa: B018
