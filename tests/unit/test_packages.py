"""What every package of the distribution has."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]


@pytest.mark.parametrize("package", PACKAGES)
def test_it_says_that_it_is_typed(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()


def test_every_package_is_measured_and_has_its_import_rules() -> None:
    names = sorted(Path(package).name for package in PACKAGES)
    assert sorted(PROJECT["tool"]["coverage"]["run"]["source_pkgs"]) == names
    assert sorted(PROJECT["tool"]["importlinter"]["root_packages"]) == names
