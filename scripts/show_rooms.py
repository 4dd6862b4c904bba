"""The rooms of the package: files, lines, and which room imports which.

    .venv/bin/python scripts/show_rooms.py
    .venv/bin/python scripts/show_rooms.py --tree OTHER_CHECKOUT     # the same of another version

The order of the rooms is the contract in pyproject.toml, which `lint-imports` checks. Here each
room stands above those that it imports; an import that runs upwards is marked with `^`.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

PACKAGE = "caliv_graph"


def modules(tree: Path) -> dict[str, Path]:
    """Dotted name -> file of every module of the package."""
    out = {}
    for path in sorted((tree / PACKAGE).rglob("*.py")):
        parts = path.relative_to(tree).with_suffix("").parts
        out[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return out


def imports(path: Path, known: Mapping[str, Path]) -> Iterator[str]:
    """Modules of the package that a file imports."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            for name in node.names:
                full = f"{node.module}.{name.name}"
                yield full if full in known else node.module
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)


def room_of(module: str, known: Mapping[str, Path]) -> str:
    """The folder below the package that a module stands in, or its own name."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and f"{PACKAGE}.{parts[1]}" in known else PACKAGE


def in_order(edges: Mapping[str, Counter[str]]) -> list[str]:
    """Rooms so that each stands above those that it imports, as far as there is such an order."""
    left, out = set(edges) | {t for targets in edges.values() for t in targets}, []
    while left:
        importers = Counter(t for room in left for t in edges.get(room, ()) if t in left)
        free = sorted(room for room in left if not importers[room])
        top = free or [min(sorted(left), key=importers.__getitem__)]
        out += top
        left -= set(top)
    return out


def main() -> int:
    """Prints the rooms."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--tree", type=Path, default=Path(__file__).resolve().parents[1])
    tree = parser.parse_args().tree
    known = modules(tree)
    if not known:
        print(f"{tree}: holds no {PACKAGE}/", file=sys.stderr)
        return 2
    files: dict[str, list[str]] = defaultdict(list)
    edges: dict[str, Counter[str]] = defaultdict(Counter)
    total = 0
    for module, path in known.items():
        room = room_of(module, known)
        lines = len(path.read_text(encoding="utf-8").splitlines())
        total += lines
        if path.name != "__init__.py":
            files[room].append(
                f"{'/'.join(path.relative_to(tree).parts[2:] or [path.name])} {lines}"
            )
        for target in imports(path, known):
            if target.startswith(PACKAGE) and (other := room_of(target, known)) != room:
                edges[room][other] += 1
    order = in_order(edges)
    for place, room in enumerate(order):
        above = set(order[:place])
        down = [f"{t}{'^' if t in above else ''} {n}" for t, n in edges[room].most_common()]
        print(
            f"{room}\n    files:   {', '.join(files[room])}\n    imports: {', '.join(down) or '-'}"
        )
    print(f"{len(known)} modules, {total} lines")
    return 0


if __name__ == "__main__":
    sys.exit(main())
