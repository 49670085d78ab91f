"""The house rules that a machine can hold: import directions, the cell's share, names, sizes, docstrings."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
SCRIPTS = sorted((ROOT / "pipelines").glob("*.py"))
CODE = SOURCES + SCRIPTS
FORBIDDEN_NAMES = {"utils", "util", "common", "helpers", "helper", "base", "misc", "tools"}
# The train extra: nothing of it may be needed where only geometry, parts and scenes are used.
TRAINING_STACK = ("torch", "lightning", "mlflow", "hydra", "omegaconf", "trimesh", "mujoco", "jaxtyping", "matplotlib")


def name_of(path: Path) -> str:
    """Test id: the path below the repository."""
    return path.relative_to(ROOT).as_posix()


def run(*command: str) -> subprocess.CompletedProcess[str]:
    """A subprocess in the repository."""
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)


def test_import_directions_are_kept() -> None:
    done = run(str(Path(sys.executable).parent / "lint-imports"), "--no-logo", "--no-cache")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_cells_share_imports_without_the_training_stack() -> None:
    program = f"""
import sys
import tomllib
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {TRAINING_STACK!r}:
            raise ImportError(f"{{name}} is not on the cell")
sys.meta_path.insert(0, Blocked())
import attentionvote.part, attentionvote.scene
import attentionvote.geometry.pointcloud, attentionvote.geometry.sampling, attentionvote.geometry.symmetry
print(sorted(set({TRAINING_STACK!r}) & set(sys.modules)))
"""
    done = run(sys.executable, "-c", program)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_the_blocked_import_test_would_notice() -> None:
    done = run(sys.executable, "-c", "import sys; sys.modules['torch'] = None; import torch")
    assert "ModuleNotFoundError" in done.stderr


def test_modules_have_a_subject_and_a_size() -> None:
    assert len(CODE) > 100
    folders = {path: {p.name for p in path.parents if p.is_relative_to(ROOT / "src")} for path in CODE}
    unnamed = [name_of(path) for path in CODE if FORBIDDEN_NAMES & {path.stem, *folders[path]}]
    assert not unnamed, f"named after nothing: {', '.join(unnamed)}"
    sizes = {name_of(path): len(path.read_text(encoding="utf-8").splitlines()) for path in CODE}
    long = {name: lines for name, lines in sizes.items() if lines > 300}
    assert not long, f"split it by subject: {long}"


def public_definitions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
    """Functions and classes that others may use, and the public methods of public classes."""
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                for item in node.body:
                    if (
                        isinstance(item, ast.FunctionDef)
                        and not item.name.startswith("_")
                        and not overrides(node, item)
                    ):
                        yield item


def overrides(owner: ast.ClassDef, method: ast.FunctionDef) -> bool:
    """Whether the method may be one of the framework's: its meaning is documented there."""
    return bool(owner.bases) and (bool(method.decorator_list) or method.name in HOOKS or method.name.startswith("on_"))


HOOKS = {
    "forward",
    "training_step",
    "validation_step",
    "test_step",
    "configure_optimizers",
    "setup",
    "prepare_data",
    "train_dataloader",
    "val_dataloader",
    "test_dataloader",
    "state_dict",
    "load_state_dict",
    "format",
}


def test_modules_and_public_names_have_docstrings() -> None:
    bare: list[str] = []
    for path in SOURCES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        named = [("the module", tree), *((node.name, node) for node in public_definitions(tree))]
        bare += [f"{name_of(path)}: {name}" for name, node in named if not ast.get_docstring(node)]
    assert not bare, f"without docstring: {', '.join(bare)}"


def test_scripts_are_doors_and_no_library_imports_them() -> None:
    """The layers, and who knows Hydra, are contracts of import-linter."""
    names = {path.stem for path in SCRIPTS}
    imported: set[str] = set()
    for path in CODE:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(str(node.module).split(".")[0])
    assert not imported & names
    lines = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in SCRIPTS}
    assert {name: count for name, count in lines.items() if count > 100} == {}
    assert len(lines) <= 21


def test_every_verb_has_one_stem_everywhere() -> None:
    verbs = {
        p.stem for p in SCRIPTS if "from attentionvote.command.entry import command" in p.read_text(encoding="utf-8")
    }
    targets = {
        line.split(":")[0] for line in (ROOT / "Makefile").read_text(encoding="utf-8").splitlines() if ": $(" in line
    }
    for verb in verbs:
        assert (ROOT / "conf" / f"{verb}.yaml").is_file(), verb
        assert verb.replace("_", "-") in targets, verb


def tracked_text() -> Iterator[tuple[str, str]]:
    """Every text file that git tracks."""
    for name in run("git", "ls-files").stdout.splitlines():
        path = ROOT / name
        if path.is_file():
            try:
                yield name, path.read_text(encoding="utf-8")
            except UnicodeDecodeError:
                continue


def test_no_file_names_a_package_registry_or_this_machine() -> None:
    # Written in pieces, so that this file does not name them either.
    forbidden = ["py" + "pi.org", "files.python" + "hosted", "download.py" + "torch", "/wo" + "rk/", "/opt/" + "wheels"]
    found = [f"{name}: {word}" for name, text in tracked_text() for word in forbidden if word in text]
    assert not found


def test_no_check_data_is_committed() -> None:
    names = run("git", "ls-files").stdout.splitlines()
    assert names
    assert not [n for n in names if n.endswith((".obj", ".stl", ".ply", ".glb", ".npz", ".ckpt", ".db"))]


def test_constraints_are_exact_and_carry_no_address() -> None:
    lines = [x for x in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines() if not x.startswith("#")]
    assert len(lines) > 50
    for line in lines:
        name, _, version = line.partition("==")
        assert name, line
        assert version, line
        assert not set("@/+; ") & set(line), line
    assert "torch==2.13.0" in lines


def test_every_c_file_is_packaged() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = patterns["tool"]["setuptools"]["package-data"]["attentionvote"]
    package = ROOT / "src" / "attentionvote"
    packaged = {path for pattern in patterns for path in package.glob(pattern)}
    assert set(package.rglob("*.c")) <= packaged
