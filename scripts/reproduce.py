"""The paper's studies, figures and tables beside ours: python scripts/reproduce.py [PART ...] [--quick] [--json FILE] [--out DIR].

Each part is a module in studies/reproduction with run(quick, folder) -> (figures as data, lines of Markdown). The parts that ran
are written to DIR/reproduction.md with their pictures, and to FILE as JSON. DIR is docs/ for a run of everything, out/ for a quick
or partial one, so that it does not take the full page's place.
"""

import argparse
import json
import textwrap
from pathlib import Path

from studies.reproduction import coverage, errata, sensitivity, sinusoids, study1, study2, tables
from studies.reproduction.summary import summary

ROOT = Path(__file__).resolve().parents[1]
PARTS = {
    "sinusoids": sinusoids,
    "sensitivity": sensitivity,
    "study1": study1,
    "study2": study2,
    "coverage": coverage,
    "tables": tables,
    "errata": errata,
}
HEAD = """# Reproduction

Made by `python scripts/reproduce.py`. The paper's studies beside ours; every row is computed when the command runs.
"""


def filled(text: str) -> str:
    """Paragraphs at the page's width; tables, headings and pictures as they are."""
    blocks = []
    for block in text.split("\n\n"):
        prose = block.strip() and not block.lstrip().startswith(("|", "#", "!["))
        blocks.append(textwrap.fill(block, 120, break_long_words=False, break_on_hyphens=False) if prose else block)
    return "\n\n".join(blocks)


def main() -> None:
    """Run the named parts, or all, and write what they found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="which parts; all by default")
    parser.add_argument("--quick", action="store_true", help="fewer cases, under a minute")
    parser.add_argument("--json", type=Path, help="write the figures as data")
    parser.add_argument("--out", type=Path, help="folder of page and pictures")
    options = parser.parse_args()
    whole = not options.parts and not options.quick
    options.out = options.out or ROOT / ("docs" if whole else "out")
    options.out.mkdir(parents=True, exist_ok=True)
    data, page, text = {}, [], ""
    for name in options.parts or PARTS:
        print(f"{name} ...", flush=True)
        data[name], lines = PARTS[name].run(options.quick, options.out)
        page += lines
        text = filled("\n".join([HEAD, *summary(data), *page]))
        (options.out / "reproduction.md").write_text(text, encoding="utf-8")
        if options.json:
            options.json.write_text(json.dumps(data, indent=1), encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
