"""The package and its programs ask PyTorch by public names, so that other versions of PyTorch serve them, too."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
# PyTorch's documentation tells users to take this by this name.
DOCUMENTED = {"torch.utils._python_dispatch.TorchDispatchMode"}


def names_of_torch(tree: ast.AST) -> Iterator[str]:
    """Every dotted name that begins with torch, also within longer ones, and what is imported from PyTorch."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node).startswith("torch."):
            yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "torch":
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "torch")


def is_private(name: str) -> bool:
    return any(part.startswith("_") and not part.startswith("__") for part in name.split("."))


def test_private_names_of_pytorch_do_not_occur() -> None:
    files = [*(ROOT / "directshape_torch").rglob("*.py"), *(ROOT / "scripts").rglob("*.py")]
    found = {name for file in files for name in names_of_torch(ast.parse(file.read_text(encoding="utf-8")))}
    private = {name for name in found if is_private(name) and not any(each.startswith(name) for each in DOCUMENTED)}
    assert private == set()
    assert found >= DOCUMENTED
