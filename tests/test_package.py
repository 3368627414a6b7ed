"""What the wheel holds: setuptools takes folders that are packages, and nothing says so of one that is not."""

from pathlib import Path

import spslam

FOLDER = Path(spslam.__file__).parent


def test_every_folder_with_modules_is_a_package():
    folders = {path.parent for path in FOLDER.rglob("*.py")}
    assert [str(folder) for folder in sorted(folders) if not (folder / "__init__.py").is_file()] == []
