"""Imports go one way, and the core install stays light: read from the syntax trees, so nothing hides in a function."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FORBIDDEN = {"augkitti": {"training", "pipelines"}, "training": {"pipelines"}, "pipelines": {"training"}}
HEAVY = {"torch", "open3d", "matplotlib", "distributed"}
SLOW_TO_START = {"numpy", "scipy", "pyarrow", "trimesh", "joblib", "pydantic", "yaml", "small_gicp", "embreex"}
CONTRACT = ("dataset", "dataset_index", "errors", "frames", "scan_pair", "seeds", "shards", "splits")
MODULES = [path for package in FORBIDDEN for path in sorted((ROOT / package).rglob("*.py"))]


def imported(nodes) -> set[str]:
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the direction"
            names.add((node.module or "").partition(".")[0])
    return names


def executed_on_import(tree: ast.AST):
    """Every node that runs when the module is imported: all but the bodies of functions and `if TYPE_CHECKING`."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING":
            continue
        yield child
        yield from executed_on_import(child)


def test_there_are_modules_to_check():
    assert len(MODULES) > 20


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path):
    package = path.relative_to(ROOT).parts[0]
    assert not imported(ast.walk(ast.parse(path.read_text()))) & FORBIDDEN[package]


@pytest.mark.parametrize(
    "path", [p for p in MODULES if "training" not in p.parts], ids=lambda path: str(path.relative_to(ROOT))
)
def test_no_module_of_the_core_needs_an_extra_to_be_imported(path):
    assert not imported(executed_on_import(ast.parse(path.read_text()))) & HEAVY


@pytest.mark.parametrize("name", ["shard_dataset", "sample", "augment_sample", "voxelize"])
def test_the_reader_of_shards_knows_the_contract_and_nothing_of_how_they_are_made(name):
    tree = ast.parse((ROOT / "training" / f"{name}.py").read_text())
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    records = {f"augkitti.{part}" for part in CONTRACT}
    assert {module for module in modules if module.startswith("augkitti")} <= records


def test_the_command_line_imports_nothing_slow_before_it_knows_the_command():
    script = "import sys, pipelines.cli; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert not set(loaded.stdout.split()) & (SLOW_TO_START | HEAVY)


def test_the_checker_sees_an_import_inside_a_class_but_not_inside_a_function():
    tree = ast.parse("class A:\n    import torch\ndef f():\n    import open3d\n")
    assert imported(executed_on_import(tree)) == {"torch"}
