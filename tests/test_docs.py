"""Every Python snippet of the documentation runs, every link points at a file, and the demo's data are the solver's."""

import json
import re
from pathlib import Path

import pytest

from tests.conftest import reference
from torchrod.cli.parser import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        assert target.startswith("http") or (page.parent / target).exists(), target


@pytest.mark.parametrize("page", [p for p in PAGES if "```python" in p.read_text()], ids=lambda p: p.name)
def test_snippets_run(page):
    for snippet in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
        exec(compile(snippet, str(page), "exec"), {})


def test_the_readme_names_options_and_commands_that_exist():
    text = (ROOT / "README.md").read_text() + (ROOT / "docs" / "files.md").read_text()
    usage = {name: make().format_help() for name, (make, _) in COMMANDS.items()}
    for option in set(re.findall(r"`(--[a-z-]+)", text)):
        assert any(option in help_text for help_text in usage.values()), option
    for command in set(re.findall(r"(?:`|^)torchrod ([a-z]+)", text, re.MULTILINE)):
        assert command in usage, command


def test_the_examples_are_the_reference_shapes():
    cases = {c["name"]: c for c in reference("shape")}
    truth = json.loads((ROOT / "docs" / "example" / "truth.json").read_text())
    assert truth["rod"] == [cases[f"passive-point-{i}"]["points"] for i in range(6)]
    rows = (ROOT / "docs" / "example" / "rod.csv").read_text().splitlines()
    first = [float(v) for v in rows[1].split(",")[1:]]
    assert first == [cases["passive-point-0"]["s"][0], *cases["passive-point-0"]["positions"][0]]
