"""docs/design.md names every module of ``sb3_eqr.common``, and the files and code that it names exist."""

import ast
import pathlib
import re

ROOT = pathlib.Path(__file__).parents[2]
PACKAGE = ROOT / "sb3_eqr"
PAGE = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")


def section(title):
    return PAGE.split(f"## {title}\n")[1].split("\n## ")[0]


def defined(node, prefix=""):
    """Dotted names of classes and functions, and of variables of modules and classes."""
    for child in node.body:
        if isinstance(child, (ast.ClassDef, ast.FunctionDef)):
            yield prefix + child.name
        if isinstance(child, ast.ClassDef):
            yield from defined(child, f"{child.name}.")
        if isinstance(child, (ast.Assign, ast.AnnAssign)):
            for target in child.targets if isinstance(child, ast.Assign) else [child.target]:
                yield prefix + ast.unparse(target)


def test_every_module_and_folder_of_modules_has_a_line_in_the_tree():
    first_cells = re.findall(r"^\| (`[^|]+) \|", section("The tree").split("|---|")[1], re.M)
    listed = [name for cell in first_cells for name in re.findall(r"`([^`]+)`", cell)]
    content = [path for path in (PACKAGE / "common").iterdir() if not path.name.startswith("__")]
    assert sorted(listed) == sorted(f"{path.name}/" if path.is_dir() else path.name for path in content)


def test_everything_named_on_the_page_exists():
    sources = [path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")]
    names = {name for source in sources for name in defined(ast.parse(source))}
    words = {word for source in sources for word in re.findall(r"\w+", source)}
    for span in re.findall(r"`([^`\n]+)`", section("The tree") + section("Where to change what")):
        name = span.strip("/")
        if re.search(r"/|\.(py|yml|toml)$", span):
            assert any(list(folder.glob(name)) for folder in (ROOT, PACKAGE, PACKAGE / "common")), span
        elif re.fullmatch(r"[A-Z]\w*(\.\w+)?", name):
            assert name in names, span
        elif re.fullmatch(r"\w+", name):
            assert name in words, span
