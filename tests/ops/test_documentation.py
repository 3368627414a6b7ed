"""Docstrings of the public ops: complete, and their examples give what they say."""

import doctest
import importlib
import inspect
import pkgutil
import re

import pytest
import torch

from spslam import ops

MODULES = [f"spslam.ops.{module.name}" for module in pkgutil.iter_modules(ops.__path__)]
FUNCTIONS = [name for name in ops.__all__ if inspect.isfunction(getattr(ops, name))]
CLASSES = [name for name in ops.__all__ if inspect.isclass(getattr(ops, name))]


@pytest.mark.parametrize("module", MODULES)
def test_examples(module):
    threads = ops.get_num_threads()
    names = {name: getattr(ops, name) for name in ops.__all__} | {"torch": torch}
    try:
        result = doctest.testmod(importlib.import_module(module), extraglobs=names)
    finally:
        ops.set_num_threads(threads)
    assert result.failed == 0


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_say_everything(name):
    function = getattr(ops, name)
    text = inspect.getdoc(function) or ""
    signature = inspect.signature(function)
    assert "Example:" in text
    if signature.parameters:
        assert "Args:" in text
        assert all(re.search(rf"\b{argument}\b", text) for argument in signature.parameters)
    if signature.return_annotation is not None and name not in ("get_num_threads", "mlp_num_params"):
        assert "Returns:" in text
    if any(parameter.annotation is torch.Tensor for parameter in signature.parameters.values()):
        assert "Raises:" in text
        assert re.search(r"\[[A-Z][^\]]*\]|\[7\]", text), "shapes"


@pytest.mark.parametrize("name", CLASSES)
def test_classes_are_described(name):
    assert inspect.getdoc(getattr(ops, name))


def test_everything_public_is_named():
    names = {name for name in vars(ops) if not name.startswith("_")}
    modules = {module.rsplit(".", 1)[1] for module in MODULES}
    assert names - modules <= set(ops.__all__)
