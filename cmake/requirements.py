"""Prints the package's requirements, and those of the extras named as arguments, a line each: what pip has no option for.

    python cmake/requirements.py dev
"""

import pathlib
import sys

from setuptools.config.pyprojecttoml import load_file

project = load_file(str(pathlib.Path(__file__).parent.parent / "pyproject.toml"))["project"]
groups = [project["dependencies"], *(project["optional-dependencies"][extra] for extra in sys.argv[1:])]
print("\n".join(requirement.replace(" ", "") for group in groups for requirement in group))
