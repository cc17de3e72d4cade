"""Run the course of jaxcal/docs, page by page, and put what its commands print into the pages.

    JAXCAL_DATA=path/to/recordings python experiments/docs_outputs.py
    JAXCAL_DATA=path/to/recordings python experiments/docs_outputs.py --only 5_judge 6_extend

A code block is run where `<!-- output -->` follows it; what stands between that and `<!-- /output -->` is replaced by
what it printed, or by a part: `<!-- output: from "verdict" lines 3 -->`. Pages share one folder and build on those
before them; the first one begins with an empty folder. Whole, they take some ten minutes. `docs_figures.py` then draws
the figures.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import platformdirs

from jaxcal.atomic import write_text

PAGES = Path(__file__).resolve().parent.parent / "jaxcal" / "docs" / "course"
COURSE = Path(platformdirs.user_cache_dir("jaxcal")) / "course"
_BLOCK = re.compile(
    r"^```(?P<kind>bash|python)\n(?P<code>(?:(?!```).*\n)*)```\n\n"
    r"<!-- output(?P<part>[^>]*) -->\n(?P<old>(?:(?!<!--).*\n)*)<!-- /output -->",
    re.MULTILINE,
)
# 3: there is a result, but it is not to be used. The course has such results, and says so.
_ACCEPTED = (0, 3)


def main() -> int:
    names = [page.stem for page in sorted(PAGES.glob("*.md"))]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=names, metavar="PAGE", default=names, help=", ".join(names))
    parser.add_argument("--work", type=Path, default=COURSE, help="folder to run in (default: %(default)s)")
    chosen = parser.parse_args()
    if "JAXCAL_DATA" not in os.environ:
        print("error: set JAXCAL_DATA to the folder of real recordings.", file=sys.stderr)
        return 1
    if names[0] in chosen.only:
        shutil.rmtree(chosen.work, ignore_errors=True)
    chosen.work.mkdir(parents=True, exist_ok=True)
    for name in chosen.only:
        page = PAGES / f"{name}.md"
        text = page.read_text()
        for block in list(_BLOCK.finditer(text)):
            print(f"{name}: {block['code'].splitlines()[0]}", flush=True)
            printed = part_of(run(block["kind"], block["code"], chosen.work), block["part"])
            head = f"```{block['kind']}\n{block['code']}```\n\n<!-- output{block['part']} -->\n"
            text = text.replace(block.group(0), f"{head}```text\n{printed}\n```\n<!-- /output -->")
            write_text(page, text)
    return 0


def run(kind: str, code: str, folder: Path) -> str:
    """What a block prints, with the places of this machine left out. Raises RuntimeError when it fails."""
    command = ["bash", "-eo", "pipefail", "-c", code] if kind == "bash" else [sys.executable, "-c", code]
    environment = os.environ | {
        "JAXCAL_DATA": str(Path(os.environ["JAXCAL_DATA"]).resolve()),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",  # this environment's jaxcal
    }
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode not in _ACCEPTED:
        raise RuntimeError(f"exit status {done.returncode} of\n{code}\n{done.stdout}{done.stderr}")
    text = done.stdout.replace(environment["JAXCAL_DATA"], "$JAXCAL_DATA").replace(str(folder.resolve()), "~/course")
    return text.strip("\n")


def part_of(printed: str, part: str) -> str:
    """The lines that a marker asks for, all without one."""
    asked = re.fullmatch(r'(?:: from "(?P<start>[^"]*)" lines (?P<count>\d+))?', part)
    if asked is None:
        raise RuntimeError(f'marker{part}: expected nothing, or: from "text" lines N')
    if asked["start"] is None:
        return printed
    lines = printed.splitlines()
    first = next((k for k, line in enumerate(lines) if asked["start"] in line), None)
    if first is None:
        raise RuntimeError(f"marker{part}: no line has that text in\n{printed}")
    last = min(first + int(asked["count"]), len(lines))
    return "\n".join([*(["..."] * (first > 0)), *lines[first:last], *(["..."] * (last < len(lines)))])


if __name__ == "__main__":
    sys.exit(main())
