"""`__all__` of each package is its public face: everything in it exists, all that it imports is in it."""

import importlib
from types import ModuleType

import pytest


@pytest.mark.parametrize("package", ["refine_client", "refine_engine"])
def test_all_lists_what_the_package_imports(package: str) -> None:
    module = importlib.import_module(package)
    imported = [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and not isinstance(value, ModuleType)
    ]
    assert module.__all__ == sorted(module.__all__)
    assert sorted(imported) == module.__all__
