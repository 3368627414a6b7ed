"""Prints the package's requirements, and those of the extras named, a line each: pip has no option for that.

python cmake/requirements.py dev
"""

import pathlib
import sys

from setuptools.config.pyprojecttoml import load_file

project = load_file(str(pathlib.Path(__file__).parent.parent / "pyproject.toml"))["project"]
groups = [project["dependencies"], *(project["optional-dependencies"][extra] for extra in sys.argv[1:])]
print("\n".join(requirement.replace(" ", "") for group in groups for requirement in group))
