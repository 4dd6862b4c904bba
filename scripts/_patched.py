"""Another value for a constant of the package, in every module that has it, for a while.

`setattr` on the module that defines a constant is not enough: `from x import NAME` copies it, and
another constant may have been worked out from it at import. The modules' text says where that is
so. What cannot be reached (a default argument, a decorator, a class body) is an error, and so is a
constant that no function reads: a sensitivity of zero would mean nothing then.
"""

from __future__ import annotations

import ast
import functools
import importlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import caliv_graph

PACKAGE = Path(caliv_graph.__file__).parent


class UnreachableError(Exception):
    """A constant that is not there, that nothing reads, or that `setattr` does not reach."""


@dataclass(frozen=True)
class Place:
    """A name in a module.

    Attributes:
        module: dotted, under `caliv_graph`.
        name: there.
    """

    module: str
    name: str


def current(module: str, name: str) -> Any:
    """The value of a constant.

    Raises:
        UnreachableError: there is no such module or name.
    """
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as e:
        raise UnreachableError(f"{module}.{name}: {e}") from None


@contextmanager
def patched(
    module: str, name: str, value: Any, beside: Sequence[str] = ()
) -> Iterator[dict[Place, Any]]:
    """Gives a constant another value while the context lasts.

    Args:
        module: that defines it.
        name: of the constant.
        value: instead of its own.
        beside: packages that stay as they are.

    Yields:
        Every place that was changed, with its new value.

    Raises:
        UnreachableError: there is no such constant, or it cannot be changed everywhere.
    """
    before = current(module, name)
    changed = {Place(module, name): value}
    reads = 0
    pending = [Place(module, name)]
    while pending:
        place = pending.pop(0)
        for copy in _imports().get(place, []):
            if copy not in changed and not copy.module.startswith(tuple(beside)):
                changed[copy] = changed[place]
                pending.append(copy)
        reads += _reads(place)
        for statement in _statements_with(place):
            namespace = dict(vars(importlib.import_module(place.module)))
            namespace |= {p.name: v for p, v in changed.items() if p.module == place.module}
            for target, derived in _evaluated(statement, namespace, place):
                changed[Place(place.module, target)] = derived
                pending.append(Place(place.module, target))
    # What stays as it is must not be imported while the value is another: it would keep that.
    for copy in _imports().get(Place(module, name), []):
        importlib.import_module(copy.module)
    if not reads:
        raise UnreachableError(f"{module}.{name} is read by no function")
    kept = {place: current(place.module, place.name) for place in changed}
    if kept[Place(module, name)] is not before:
        raise UnreachableError(f"{module}.{name} is already changed")
    for place, new in changed.items():
        setattr(importlib.import_module(place.module), place.name, new)
    try:
        yield changed
    finally:
        for place, old in kept.items():
            setattr(importlib.import_module(place.module), place.name, old)


@functools.cache
def _trees() -> dict[str, ast.Module]:
    """The text of every module of the package, by its dotted name."""
    out = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        out[name] = ast.parse(path.read_text(encoding="utf-8"))
    return out


@functools.cache
def _imports() -> dict[Place, list[Place]]:
    """Names that `from module import name` made, by what they are copies of."""
    out: dict[Place, list[Place]] = {}
    for module, tree in _trees().items():
        # An import within a function is done anew at every call, and finds the new value.
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    copy = Place(module, alias.asname or alias.name)
                    out.setdefault(Place(node.module, alias.name), []).append(copy)
    return out


@functools.cache
def _attributes() -> Counter[tuple[str, str]]:
    """How often `module.NAME` stands anywhere, by the module's last name and the attribute's."""
    return Counter(
        (node.value.id, node.attr)
        for tree in _trees().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
    )


@functools.cache
def _loaded(node: ast.AST) -> Counter[str]:
    """How often each name is read in a piece of text: many constants are looked for in it."""
    return Counter(
        n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)
    )


def _loads(node: ast.AST, name: str) -> int:
    """How often a name is read in a piece of text."""
    return _loaded(node)[name]


@functools.cache
def _functions(module: str) -> list[ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda]:
    """The functions of a module, those within others included."""
    kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
    return [node for node in ast.walk(_trees()[module]) if isinstance(node, kinds)]


def _reads(place: Place) -> int:
    """How often functions read it, by its name or as an attribute of its module.

    Raises:
        UnreachableError: a function took it at import, as a default argument or in a decorator.
    """
    count = 0
    for function in _functions(place.module):
        defaults = [*function.args.defaults, *filter(None, function.args.kw_defaults)]
        taken = [*defaults, *getattr(function, "decorator_list", [])]
        if any(_loads(node, place.name) for node in taken):
            raise UnreachableError(
                f"{place.module}.{place.name} is taken at import, line {function.lineno}"
            )
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            count += sum(_loads(statement, place.name) for statement in function.body)
    return count + _attributes()[place.module.rpartition(".")[2], place.name]


def _statements_with(place: Place) -> list[ast.stmt]:
    """Statements of the module itself that read the name when the module is imported.

    Raises:
        UnreachableError: a class body does.
    """
    out: list[ast.stmt] = []
    for statement in _trees()[place.module].body:
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ImportFrom):
            continue
        if isinstance(statement, ast.ClassDef):
            fields = [s for s in statement.body if not isinstance(s, ast.FunctionDef)]
            if any(_loads(field, place.name) for field in fields):
                raise UnreachableError(
                    f"{place.module}.{place.name} is taken by class {statement.name}"
                )
            continue
        if _loads(statement, place.name):
            out.append(statement)
    return out


def _evaluated(
    statement: ast.stmt, namespace: dict[str, Any], place: Place
) -> Iterator[tuple[str, Any]]:
    """Names that a statement assigns, with their values in a namespace.

    Raises:
        UnreachableError: it is no plain assignment to names.
    """
    targets = (
        statement.targets
        if isinstance(statement, ast.Assign)
        else [statement.target]
        if isinstance(statement, ast.AnnAssign)
        else []
    )
    if not targets or not all(isinstance(target, ast.Name) for target in targets):
        raise UnreachableError(
            f"{place.module}.{place.name} is used at import, line {statement.lineno}"
        )
    exec(compile(ast.Module([statement], []), place.module, "exec"), namespace)
    for target in targets:
        assert isinstance(target, ast.Name)
        yield target.id, namespace[target.id]
