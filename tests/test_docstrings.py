"""Docstrings have one style: Google's sections, and single backticks for code."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MODULES = sorted((ROOT / "spslam").rglob("*.py"))
NUMPY_SECTION = re.compile(r"^ *(\w+)\n *-{4,}$", re.MULTILINE)
SPHINX_ROLE = re.compile(r":(?:func|class|meth|mod|attr|data|exc):`")
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def docstrings(path):
    """Line number and text of all docstrings in a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node):
            yield node.body[0].lineno, ast.get_docstring(node)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_docstrings_are_google_style(path):
    for line, text in docstrings(path):
        section = NUMPY_SECTION.search(text)
        assert section is None, f"line {line}: write `{section[1]}:` and indent what follows"
        assert SPHINX_ROLE.search(text) is None, f"line {line}: write names in single backticks, without a role"
        assert "``" not in text, f"line {line}: write code in single backticks"
