"""This module makes mutants of a function from its syntax tree: every arithmetic node, component, axis and term pair.

All rules are mechanical:

- sign flip: `a + b` becomes `a - b` and back; `-a` becomes `a`; an outermost arithmetic expression, an element of a
  list, an argument of a constructor and a value stored into a slice become their negative;
- dropped term: `a + b` becomes `a`, and `b`; likewise `a - b`;
- dropped factor: `a * b` becomes `a`, and `b`; `a / b` becomes `a`, and `1 / b`; `a @ b` becomes `a`, and `b`;
  `a ** 2` becomes `a`;
- swapped axis or component: `x[..., 1]` becomes `x[..., 0]`, `x[:3]` becomes `x[3:6]`; neighbours in a list or in an
  assignment of several names change places; a transposition is dropped, or put before a matrix product; the arguments
  of a cross product, of a batched matrix product, of an interpolation and of `where` change places.

Arithmetic in shapes (arguments of `new_zeros`, `expand`, ...) is not arithmetic of a Jacobian and is not changed.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

_SHAPE_MAKERS = {"new_zeros", "zeros", "expand", "reshape", "view", "view_as", "repeat", "eye", "arange", "range"}
_ZERO_MAKERS = {"new_zeros", "zeros", "zeros_like"}
# These two arguments of a call are exchanged.
_SWAPPED_ARGUMENTS = {"cross": (0, 1), "bmm": (0, 1), "lerp": (0, 1), "_along": (1, 2), "where": (1, 2)}
_ARITHMETIC = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.MatMult, ast.Pow)


@dataclass(frozen=True)
class Mutant:
    """A `Mutant` is one change of one expression of one function."""

    path: str  # path of the file, below the root of the tree
    function: str  # qualified name within the file
    line: int
    kind: str
    before: str
    after: str
    start: int  # byte offsets of the expression in the file
    end: int

    def apply(self, source: bytes) -> bytes:
        """The content of the file with this change."""
        return source[: self.start] + self.after.encode() + source[self.end :]

    def __str__(self) -> str:
        return f"{self.path}:{self.line} {self.function}: {self.kind}: {self.before}  ->  {self.after}"


def mutants_of(path: str, source: bytes, functions: tuple[str, ...]) -> list[Mutant]:
    """All mutants of the named functions of a file, in the order of the file.

    Raises:
        KeyError: the file has no function with this name.
    """
    offsets = _line_offsets(source)
    definitions = dict(_functions(ast.parse(source)))
    found: dict[tuple[int, int, str], Mutant] = {}
    for name in functions:
        for node, kind, after in _Changes().of(definitions[name]):
            assert node.end_lineno is not None
            assert node.end_col_offset is not None
            start = offsets[node.lineno - 1] + node.col_offset
            end = offsets[node.end_lineno - 1] + node.end_col_offset
            mutant = Mutant(path, name, node.lineno, kind, ast.unparse(node), after, start, end)
            found.setdefault((start, end, after), mutant)
    return sorted(found.values(), key=lambda m: (m.start, m.end, m.after))


def _line_offsets(source: bytes) -> list[int]:
    offsets = [0]
    for line in source.splitlines(keepends=True):
        offsets.append(offsets[-1] + len(line))
    return offsets


def _functions(tree: ast.AST, prefix: str = "") -> Iterator[tuple[str, ast.FunctionDef]]:
    """Qualified name and definition of every function and method."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            yield prefix + node.name, node
        if isinstance(node, ast.ClassDef):
            yield from _functions(node, f"{prefix}{node.name}.")


def _negative(node: ast.expr) -> ast.expr:
    return ast.UnaryOp(ast.USub(), node)


def _is_tensor_like(node: ast.expr) -> bool:
    """Whether an expression may hold numbers other than zero, and no other rule flips it."""
    if isinstance(node, ast.Call):
        return _called_name(node) not in _ZERO_MAKERS
    return isinstance(node, ast.Name | ast.Attribute | ast.Subscript)


def _is_arithmetic(node: ast.AST) -> bool:
    if isinstance(node, ast.BinOp):
        return isinstance(node.op, _ARITHMETIC)
    return isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub)


Change = tuple[ast.expr, str, str]


class _Changes:
    """A `_Changes` walks a function and yields (expression, kind of change, new text)."""

    def of(self, function: ast.FunctionDef) -> Iterator[Change]:
        for statement in function.body:
            yield from self._walk(statement, outermost=True)

    def _walk(self, node: ast.AST, outermost: bool) -> Iterator[Change]:
        if isinstance(node, ast.Raise | ast.Assert | ast.FunctionDef):
            if isinstance(node, ast.FunctionDef):
                yield from self.of(node)
            return
        arithmetic = _is_arithmetic(node)
        if arithmetic:
            assert isinstance(node, ast.BinOp | ast.UnaryOp)
            yield from _arithmetic_changes(node, outermost)
        elif isinstance(node, ast.Call):
            yield from _call_changes(node)
        elif isinstance(node, ast.Subscript):
            yield from _component_changes(node)
        elif isinstance(node, ast.Attribute) and node.attr == "mT":
            yield node, "swapped axes", _text(node.value)
        elif isinstance(node, ast.List | ast.Tuple) and isinstance(node.ctx, ast.Load):
            yield from _display_changes(node)
        elif isinstance(node, ast.Assign):
            yield from _assignment_changes(node)
        for child in _children(node):
            yield from self._walk(child, outermost=not arithmetic)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """Child nodes without shapes, indices and annotations."""
    if isinstance(node, ast.Subscript):
        yield node.value
    elif isinstance(node, ast.Call) and _called_name(node) in _SHAPE_MAKERS:
        yield node.func
    elif isinstance(node, ast.AnnAssign):
        if node.value is not None:
            yield node.value
    else:
        yield from ast.iter_child_nodes(node)


def _called_name(node: ast.Call) -> str:
    if isinstance(node.func, ast.Attribute):
        return node.func.attr
    return node.func.id if isinstance(node.func, ast.Name) else ""


def _arithmetic_changes(node: ast.BinOp | ast.UnaryOp, outermost: bool) -> Iterator[Change]:
    if isinstance(node, ast.UnaryOp):
        # A negative integer is an axis (`sum(-1)`), a negative float a number.
        if not (isinstance(node.operand, ast.Constant) and isinstance(node.operand.value, int)):
            yield node, "sign flip", _text(node.operand)
        return
    if outermost:
        yield node, "sign flip", _text(_negative(node))
    left, right = node.left, node.right
    if isinstance(node.op, ast.Add | ast.Sub):
        plus = isinstance(node.op, ast.Add)
        if not (isinstance(left, ast.Constant) and left.value == 0):
            yield node, "sign flip", _text(ast.BinOp(left, ast.Sub() if plus else ast.Add(), right))
            yield node, "dropped term", _text(right if plus else _negative(right))
        yield node, "dropped term", _text(left)
    elif isinstance(node.op, ast.Mult | ast.MatMult):
        yield node, "dropped factor", _text(left)
        yield node, "dropped factor", _text(right)
        if isinstance(node.op, ast.MatMult):
            transposed = ast.Attribute(left, "mT", ast.Load())
            yield node, "swapped axes", _text(ast.BinOp(transposed, ast.MatMult(), right))
    else:
        yield node, "dropped factor", _text(left)
        if isinstance(node.op, ast.Div) and not (isinstance(left, ast.Constant) and left.value == 1):
            yield node, "dropped factor", _text(ast.BinOp(ast.Constant(1), ast.Div(), right))


def _call_changes(node: ast.Call) -> Iterator[Change]:
    name = _called_name(node)
    swapped = _SWAPPED_ARGUMENTS.get(name)
    if swapped is not None and len(node.args) > max(swapped):
        args = list(node.args)
        args[swapped[0]], args[swapped[1]] = args[swapped[1]], args[swapped[0]]
        if ast.dump(args[swapped[0]]) != ast.dump(args[swapped[1]]):
            yield node, "swapped arguments", _text(ast.Call(node.func, args, node.keywords))
    if name == "transpose" and isinstance(node.func, ast.Attribute):
        yield node, "swapped axes", _text(node.func.value)
    if name[:1].isupper():  # a named tuple of results
        for argument in node.args:
            if _is_tensor_like(argument):
                yield argument, "sign flip", _text(_negative(argument))


def _display_changes(node: ast.List | ast.Tuple) -> Iterator[Change]:
    for element in node.elts:
        if _is_tensor_like(element):
            yield element, "sign flip", _text(_negative(element))
    yield from _neighbour_swaps(node)


def _assignment_changes(node: ast.Assign) -> Iterator[Change]:
    target = node.targets[0]
    if isinstance(target, ast.Subscript) and _is_tensor_like(node.value):
        yield node.value, "sign flip", _text(_negative(node.value))
    if isinstance(target, ast.Tuple) and not isinstance(node.value, ast.Tuple):
        yield from _neighbour_swaps(target)


def _neighbour_swaps(node: ast.List | ast.Tuple) -> Iterator[Change]:
    for i in range(len(node.elts) - 1):
        elements = list(node.elts)
        if ast.dump(elements[i]) == ast.dump(elements[i + 1]):
            continue
        elements[i], elements[i + 1] = elements[i + 1], elements[i]
        yield node, "swapped components", ast.unparse(type(node)(elements, node.ctx))


def _component_changes(node: ast.Subscript) -> Iterator[Change]:
    parts = list(node.slice.elts) if isinstance(node.slice, ast.Tuple) else [node.slice]
    for i, part in enumerate(parts):
        other = _other_component(part)
        if other is None:
            continue
        changed = [*parts[:i], other, *parts[i + 1 :]]
        index = ast.Tuple(changed, ast.Load()) if isinstance(node.slice, ast.Tuple) else changed[0]
        yield node, "swapped components", ast.unparse(ast.Subscript(node.value, index, node.ctx))


def _other_component(part: ast.expr) -> ast.expr | None:
    """A neighbouring component: 2 for 1, 1 for 0, or the neighbouring block of a slice with constant ends."""
    if isinstance(part, ast.Constant) and isinstance(part.value, int) and not isinstance(part.value, bool):
        return ast.Constant(part.value - 1 if part.value > 0 else 1)
    if not isinstance(part, ast.Slice) or part.step is not None:
        return None
    low, high = _constant(part.lower), _constant(part.upper)
    if high is None:
        return None if low is None else ast.Slice(None, ast.Constant(low), None)
    low = low or 0
    length = high - low
    start = low - length if low >= length else high
    return ast.Slice(ast.Constant(start), ast.Constant(start + length), None)


def _constant(node: ast.expr | None) -> int | None:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, int) else None


def _text(node: ast.expr) -> str:
    """Source of an expression that may be placed anywhere in another one."""
    return f"({ast.unparse(node)})"
