"""Each ``literalinclude`` of the pages shows a complete function or statement that exists. Read with Sphinx's own reader."""

import ast
import pathlib
import re
from types import SimpleNamespace

import pytest
from sphinx.directives.code import LiteralIncludeReader

DOCS = pathlib.Path(__file__).parents[2] / "docs"
PAGES = sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts)
LEGAL_OPTIONS = {"pyobject", "start-at", "end-before", "dedent"}  # line numbers go stale
INCLUDE = re.compile(r"^```\{literalinclude\} (\S+)\n(.*?)^```$", re.M | re.S)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_included_code_exists(page):
    text = page.read_text(encoding="utf-8")
    found = list(INCLUDE.finditer(text))
    assert text.count("{literalinclude}") == len(found)  # none is missed by the pattern
    for match in found:
        options = dict(re.findall(r"^:([\w-]+): *(.*)$", match[2], re.M))
        assert options.keys() <= LEGAL_OPTIONS
        options |= {key: int(options[key]) for key in options.keys() & {"dedent"}}
        path = str((page.parent / match[1]).resolve())
        code, _ = LiteralIncludeReader(path, options, SimpleNamespace(source_encoding="utf-8")).read()
        assert ast.parse(code).body
