"""The examples of the documentation run as written."""

import doctest
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
OPS_PAGES = sorted((ROOT / "docs" / "ops").glob("*.md"))


def python_blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", OPS_PAGES, ids=lambda path: path.stem)
def test_examples_of_the_ops(page):
    text = "\n".join(python_blocks(page))
    examples = doctest.DocTestParser().get_doctest(text, {}, page.name, str(page), 0)
    assert examples.examples
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(examples).failed == 0


def test_posed_fusion_page_runs_and_is_the_example():
    blocks = python_blocks(ROOT / "docs" / "posed-fusion.md")
    script = (ROOT / "examples" / "posed_fusion.py").read_text(encoding="utf-8")
    functions = [block for block in blocks if block.startswith("def ")]
    assert len(functions) == 3
    assert all(block.rstrip() in script for block in functions)
    names: dict = {}
    for block in blocks:
        exec(compile(block, "posed-fusion.md", "exec"), names)
    assert len(names["faces"]) > 1000


@pytest.mark.parametrize("page", OPS_PAGES, ids=lambda path: path.stem)
def test_functions_named_exist(page):
    from spslam import ops

    rows = re.findall(r"^\| (`[^|]*) \|", page.read_text(encoding="utf-8"), re.MULTILINE)
    names = {name for row in rows for name in re.findall(r"`(\w+)[(`]", row) if not name.startswith("_")}
    assert names <= set(ops.__all__)
