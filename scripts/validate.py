"""The forward model beside shapes that other code, or a camera, made.

    python scripts/validate.py [--quick] [--json FILE] [--out FOLDER]

Each part is a module in scripts/studies/validation with run(quick, folder) -> (figures as data, lines of Markdown).
FOLDER/validation.md (docs/ by default, out/ with --quick) gets the summary, the sections and their pictures; FILE the figures as
JSON. A part whose data are not at hand is skipped, and the page and the screen say so.
"""

import argparse
import json
import textwrap
from itertools import groupby
from pathlib import Path
from types import ModuleType
from typing import Any

from studies.validation import beam, elastica, shapes, sorosim, tendons
from studies.validation.common import ROOT, SkippedError, summary_line

PARTS = {"sorosim": sorosim, "tendons": tendons, "elastica": elastica, "beam": beam, "shapes": shapes}
HEAD = """# Validation

Made by `python scripts/validate.py`{quick}. The forward model, with its default of 40 steps where nothing else is said, beside
shapes that other code, or a camera, made; every number is computed when the command runs. An error is the distance between our
point and theirs; where a case is a shape, the largest along it.

| reference | what | cases | median | 95 % | worst | unit |
|---|---|---|---|---|---|---|
"""


def run_part(module: ModuleType, quick: bool, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """A part's figures and section; where its data are missing, the reason."""
    try:
        return module.run(quick, folder)
    except SkippedError as reason:
        return {"skipped": str(reason)}, [f"skipped: {reason}"]


def wrapped(lines: list[str]) -> list[str]:
    """Paragraphs filled to the page's width; tables, pictures and empty lines as they are."""
    filled = []
    for is_text, group in groupby(lines, lambda line: line[:1] not in ("", "|", "!")):
        block = list(group)
        filled += textwrap.wrap(" ".join(block), 120, break_long_words=False, break_on_hyphens=False) if is_text else block
    return filled


def page_of(data: dict[str, Any], sections: dict[str, list[str]], quick: bool) -> str:
    """The whole page: summary first, then a section for each part."""
    table = []
    for name, figures in data.items():
        table += [summary_line(row) for row in figures.get("rows", [])]
        if "skipped" in figures:
            table.append(f"| {PARTS[name].TITLE} | skipped: {figures['skipped']} | 0 | - | - | - | - |")
    text = HEAD.format(quick=" --quick" if quick else "") + "\n".join(table) + "\n"
    for name, lines in sections.items():
        text += "\n".join(["", f"## {PARTS[name].TITLE}", "", *wrapped(lines), ""])
    return text


def main() -> None:
    """Run every part and write what they found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer repeats; the page then goes to out/, not to docs/")
    parser.add_argument("--json", type=Path, help="write the figures as data")
    parser.add_argument("--out", type=Path, help="folder of page and pictures")
    options = parser.parse_args()
    folder = options.out or ROOT / ("out" if options.quick else "docs")
    folder.mkdir(parents=True, exist_ok=True)
    data, sections = {}, {}
    for name, module in PARTS.items():
        print(f"{name} ...", flush=True)
        data[name], sections[name] = run_part(module, options.quick, folder)
    page = page_of(data, sections, options.quick)
    (folder / "validation.md").write_text(page, encoding="utf-8")
    if options.json:
        options.json.write_text(json.dumps(data, indent=1), encoding="utf-8")
    print(page)


if __name__ == "__main__":
    main()
