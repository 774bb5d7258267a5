"""Every kernel can be read: its signature says what goes in and what comes out, and it is true."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
import twin_calls

PACKAGE = Path(__file__).resolve().parents[2] / "taichi_unifusion"
FILES = sorted(path for path in PACKAGE.rglob("kernels/*.py") if path.name != "__init__.py")
GROUPS = ["in", "in and out", "out"]
MOST_ARGUMENTS = 14
ATOMICS = {"atomic_add", "atomic_max", "atomic_min", "atomic_or", "atomic_and", "atomic_xor"}
# a shape in brackets, as in (B, 27) or (S, q + q (q + 1) / 2, 1)
SHAPE = re.compile(r"\([^)]*[A-Za-z0-9^]\s*,.*\)")


@dataclass(frozen=True)
class Signature:
    """A kernel, or a function that is inlined into kernels, as its source says."""

    file: Path
    node: ast.FunctionDef
    groups: dict[str, str]  # argument -> group, as far as the source has groups
    order: tuple[str, ...]  # groups as they come
    comments: dict[str, str]  # argument -> what is said of it, on its line or just above

    @property
    def arguments(self) -> list[str]:
        return [argument.arg for argument in self.node.args.args]


@cache
def functions(file: Path) -> dict[str, Signature]:
    """The functions that a file of kernels defines or imports from another, by name."""
    found, lines = {}, file.read_text().splitlines()
    for node in ast.parse("\n".join(lines)).body:
        if isinstance(node, ast.FunctionDef):
            found[node.name] = read_signature(file, node, lines)
        elif isinstance(node, ast.ImportFrom) and node.level and node.module:
            other = (
                file.parents[node.level - 1].joinpath(*node.module.split(".")).with_suffix(".py")
            )
            if other in FILES:
                names = {alias.name for alias in node.names}
                found |= {name: each for name, each in functions(other).items() if name in names}
    return found


def read_signature(file: Path, node: ast.FunctionDef, lines: list[str]) -> Signature:
    groups, order, comments, group, above = {}, [], {}, "", ""
    arguments = {argument.lineno: argument.arg for argument in node.args.args}
    for number in range(node.lineno, node.body[0].lineno):
        code, _, comment = lines[number - 1].partition("#")
        if number in arguments:
            groups[arguments[number]] = group
            comments[arguments[number]] = f"{above} {comment}".strip()
            above = ""
        elif not code.strip() and comment:
            if (name := comment.strip().partition(":")[0]) in GROUPS and ":" in comment:
                group = name
                order.append(name)
            else:
                above = f"{above} {comment.strip()}"
    return Signature(file, node, groups, tuple(order), comments)


def is_kernel(signature: Signature) -> bool:
    return any(ast.unparse(each) == "ti.kernel" for each in signature.node.decorator_list)


def base_name(node: ast.expr) -> str:
    """The variable that an expression such as `index.slot[ijk]` or `pools.means[s, c]` starts at."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def written(signature: Signature) -> frozenset[str]:
    """The arguments of a function that it writes into, itself or through functions that it calls."""
    found, known = set(), functions(signature.file)
    for node in ast.walk(signature.node):
        if isinstance(node, ast.Assign | ast.AugAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            flat = [t for target in targets for t in getattr(target, "elts", [target])]
            found |= {base_name(target) for target in flat if isinstance(target, ast.Subscript)}
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func).split(".")[-1]
            if called in ATOMICS:
                found.add(base_name(node.args[0]))
            elif called in known and called != signature.node.name:
                callee = known[called]
                changed = written(callee)
                for argument, value in zip(callee.arguments, node.args, strict=False):
                    if argument in changed:
                        found.add(base_name(value))
    return frozenset(found & set(signature.arguments))


KERNELS = {
    signature.node.name: signature
    for file in FILES
    for signature in functions(file).values()
    if is_kernel(signature)
}


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_a_kernel_has_its_arguments_in_groups_in_order(name):
    signature = KERNELS[name]
    assert "".join(signature.groups.values()), "no group at all"
    assert all(signature.groups.values()), "an argument stands before the first group"
    places = [GROUPS.index(group) for group in signature.order]
    assert places == sorted(set(places)), f"groups come as {signature.order}, not as {GROUPS}"
    assert len(signature.arguments) <= MOST_ARGUMENTS


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_a_kernel_says_the_shape_of_every_array(name):
    signature = KERNELS[name]
    bare = [
        argument.arg
        for argument in signature.node.args.args
        if is_array(argument.annotation) and not SHAPE.search(signature.comments[argument.arg])
    ]
    assert bare == []


def is_array(annotation: ast.expr | None) -> bool:
    text = ast.unparse(annotation) if annotation is not None else ""
    return "ndarray" in text or re.fullmatch(r"[A-Z][A-Za-z]+[1-4]", text) is not None


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_a_kernel_writes_what_its_signature_says_and_nothing_else(name):
    signature = KERNELS[name]
    groups, changed = signature.groups, written(signature)
    assert {argument for argument in changed if groups[argument] == "in"} == set()
    promised = {argument for argument, group in groups.items() if group != "in"}
    assert promised - changed == set(), "under `# out:`, but never written"


def test_the_rules_see_what_a_function_writes_for_its_caller():
    """`touch` writes the index, and so does every kernel that calls it."""
    index, regression, gram = (
        functions(PACKAGE / "kernels" / f"{n}.py") for n in ("index", "regression", "gram")
    )
    assert (
        written(index["touch"]) == {"index", "keys", "counters"} <= written(index["touch_points"])
    )
    assert "scratch" in written(regression["add_samples"]) and "G" in written(gram["take_products"])


def test_every_kernel_has_a_twin_or_is_bookkeeping():
    """Said here at once; that a test calls both is only known at the end of a whole run."""
    kernels = twin_calls.kernel_names()
    assert kernels - twin_calls.BOOKKEEPING <= twin_calls.twin_names()
    assert kernels >= twin_calls.BOOKKEEPING
